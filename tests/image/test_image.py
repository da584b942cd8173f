"""The image of docker/Dockerfile as it runs: read-only, without privileges, with the frames of this machine."""

import json
import os
import re
import shlex
import socket
import subprocess
from collections.abc import Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import httpx
import pytest

from ultragray.datasets.released import write_released
from ultragray.phantom.demo import copy_demo_scene

from ..service.conftest import service_starter
from ..service.test_lifecycle import IDENTITY
from ..waiting import wait_until
from ..workers.jobs.conftest import tiny_dataset

# The root is read-only. $1: the root, $2 … $4: where /data, the cache and /tmp are; the rest is the command.
_ENTER = """
set -eu
root=$1 data=$2 cache=$3 temporary=$4; shift 4
mount --make-rprivate /
mount --bind "$root" "$root"
mount -t proc proc "$root/proc"
mount --rbind /dev "$root/dev"
mount --bind /etc/hosts "$root/etc/hosts"
mount --bind "$data" "$root/data"
mount --bind "$cache" "$root/var/cache/ultragray"
mount --bind "$temporary" "$root/tmp"
mount -o remount,bind,ro "$root"
cd /
exec chroot "$root" "$@"
"""


@dataclass(frozen=True)
class Container:
    """One image, mounted, with its writable folders beside it."""

    root: Path
    folder: Path  # holds data, cache and tmp
    configuration: Mapping[str, Any]  # what the image says: User, Env, Cmd, Healthcheck, Labels …

    @property
    def data(self):
        return self.folder / "data"

    def command(self, *words, environment=None):
        """What starts `words` as the image's user, in its environment and working folder."""
        user, _, group = self.configuration["User"].partition(":")
        variables = [*self.configuration["Env"], *(f"{name}={value}" for name, value in (environment or {}).items())]
        folders = [str(self.folder / name) for name in ("data", "cache", "tmp")]
        inside = f"cd {shlex.quote(self.configuration['WorkingDir'])} && exec {shlex.join(words)}"
        return [
            *("unshare", "--mount", "sh", "-c", _ENTER, "sh", str(self.root), *folders),
            *("/usr/bin/setpriv", "--reuid", user, "--regid", group or user, "--clear-groups"),
            *("--no-new-privs", "--inh-caps=-all", "--bounding-set=-all"),
            *("/usr/bin/env", "--ignore-environment", *variables, "/bin/sh", "-c", inside),
        ]

    def run(self, *words, environment=None):
        command = self.command(*words, environment=environment)
        return subprocess.run(command, capture_output=True, text=True, timeout=300)

    def start(self, words, environment, log):
        """The process that is returned is the one of `words` itself: signals reach it."""
        return subprocess.Popen(self.command(*words, environment=environment), stderr=log, stdin=subprocess.DEVNULL)


@contextmanager
def container_of(image, folder):
    """The container lives as long as the `with` block; `folder` keeps what it wrote."""
    inspected = subprocess.run(["buildah", "inspect", "--type", "image", image], check=True, capture_output=True)
    configuration = json.loads(inspected.stdout)["Docker"]["config"]
    user, _, group = configuration["User"].partition(":")
    for name in ("data", "cache", "tmp"):
        (folder / name).mkdir()
        subprocess.run(["chown", f"{user}:{group}", folder / name], check=True)
    name = subprocess.run(
        ["buildah", "from", "--pull-never", image], check=True, stdout=subprocess.PIPE, text=True
    ).stdout.strip()
    try:
        mounted = subprocess.run(["buildah", "mount", name], check=True, stdout=subprocess.PIPE, text=True)
        root = Path(mounted.stdout.strip())
        (root / "etc" / "hosts").touch()  # engines make it
        yield Container(root, folder, configuration)
    finally:
        subprocess.run(["buildah", "rm", name], check=True, stdout=subprocess.DEVNULL)


IMAGE = os.environ.get("ULTRAGRAY_TEST_IMAGE", "")
MAX_BYTES = 1_250_000_000
# Packages whose licences are texts that the tools do not know: BSD's, the LGPL, Python's own.
IN_WORDS_ALONE = {"protobuf", "libcrypt1", "libpython3-stdlib", "python3", "python3-minimal"}
PERMISSIVE = re.compile(
    r"(?i)0BSD|Apache|BSD|HPND|ISC|MIT|PSF|Python-2\.0|Unlicense|Zlib|CC0-1\.0|MPL-2\.0|LGPL|Unicode|BSL-1\.0"
)

pytestmark = pytest.mark.skipif(not IMAGE, reason="no image is named: make test-image builds one")


@pytest.fixture(scope="module")
def container(tmp_path_factory):
    with container_of(IMAGE, tmp_path_factory.mktemp("container")) as container:
        yield container


class ContainedService:
    """The image's own command, on free ports of this machine."""

    def __init__(self, container):
        with socket.socket() as one, socket.socket() as other:
            one.bind(("127.0.0.1", 0))
            other.bind(("127.0.0.1", 0))
            self.http_port, grpc_port = one.getsockname()[1], other.getsockname()[1]
        self.http = f"http://127.0.0.1:{self.http_port}"
        self.environment = {
            "ULTRAGRAY_HOST": "127.0.0.1",
            "ULTRAGRAY_HTTP_PORT": str(self.http_port),
            "ULTRAGRAY_GRPC_PORT": str(grpc_port),
            "ULTRAGRAY_ADDRESS": self.http,
        }
        self.container = container
        self.log_path = container.folder / "log"
        with self.log_path.open("wb") as log:
            self.process = container.start(container.configuration["Cmd"], self.environment, log)

    def healthy(self):
        """What the image's health check says."""
        kind, *words = self.container.configuration["Healthcheck"]["Test"]
        assert kind == "CMD"
        return self.run(*words).returncode == 0

    def run(self, *words):
        return self.container.run(*words, environment=self.environment)


@pytest.fixture(scope="module")
def start_service(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    copy_demo_scene(folder / "demo.ugr")
    yield from service_starter(tmp_path_factory, folder)


@pytest.fixture(scope="module")
def contained(container):
    """Ends with a SIGTERM, at which the service must exit with 0. It puts the demo scene into its folder by itself."""
    service = ContainedService(container)
    try:
        wait_until(lambda: service.process.poll() is not None or service.healthy(), within_s=300, every_s=0.5)
        assert service.process.poll() is None, service.log_path.read_text()
        yield service
        service.process.terminate()
        assert service.process.wait(60) == 0
    finally:
        service.process.kill()
        service.process.wait()


@pytest.mark.parametrize(
    ("form", "outputs"),
    [("image/png", ["bmode"]), ("application/octet-stream;dtype=float32", ["bmode", "transmittance"])],
)
def test_frames_are_those_of_this_machine(contained, start_service, form, outputs):
    here = start_service()

    def frame(address):
        answer = httpx.post(
            f"{address}/v1/scenes/demo/render",
            json={"pose": IDENTITY, "height": 256, "width": 256, "outputs": outputs},
            headers={"Accept": form},
            timeout=120,
        )
        assert answer.status_code == 200, answer.text
        return answer.content

    assert frame(contained.http) == frame(here.http)


def test_console_is_in_the_image(contained):
    answer = httpx.get(contained.http, timeout=60)
    assert answer.status_code == 200
    assert "<html" in answer.text


def test_jobs_train_and_render_in_it(contained):
    write_released(tiny_dataset(), contained.container.folder / "tmp" / "tiny")

    def succeed(*words):
        done = contained.run("ultragray", *words)
        assert done.returncode == 0, done.stdout + done.stderr + contained.log_path.read_text()

    settings = ("--set", "steps=20", "--set", "max_gaussians=40", "--set", "batch_size=2")
    succeed("datasets", "upload", "/tmp/tiny", "--name", "tiny")
    succeed("jobs", "submit", "train", "tiny", "--scene", "trained", *settings, "--wait")
    succeed("jobs", "submit", "render", "trained", "--sampler", "around", "--count", "4", "--wait")
    succeed("jobs", "submit", "evaluate", "tiny", "--scene", "trained", "--wait")
    assert httpx.get(f"{contained.http}/v1/scenes/trained", timeout=60).status_code == 200


def test_user_has_no_privileges_and_the_root_is_read_only(container):
    script = "id -u; grep CapEff /proc/self/status; touch /opt/ultragray/x; touch /data/x /tmp/x /var/cache/ultragray/x"
    done = container.run("sh", "-c", script)
    assert done.stdout.split() == ["10001", "CapEff:", "0000000000000000"]
    assert "Read-only file system" in done.stderr
    assert done.stderr.count("\n") == 1, "only the first touch may fail"


def test_command_line_and_library_are_there(container):
    assert "Serve scenes over HTTP and gRPC" in container.run("ultragray", "--help").stdout
    assert container.run("ultragray", "--version").stdout.strip().endswith(version("ultragray"))


@pytest.mark.parametrize("command", ["gcc", "c++", "make", "pip", "node"])
def test_nothing_is_left_of_what_built_it(container, command):
    assert container.run("sh", "-c", f"command -v {command}").stdout == ""


def test_image_says_what_it_is(container):
    says = container.configuration
    assert says["User"] == "10001:10001"
    assert set(says["ExposedPorts"]) == {"8000/tcp", "50051/tcp", "18944/tcp"}
    assert set(says["Volumes"]) == {"/data", "/var/cache/ultragray"}
    labels = {name.removeprefix("org.opencontainers.image."): value for name, value in says["Labels"].items()}
    assert labels["version"] == version("ultragray")
    assert re.match(r"[0-9a-f]{40}", labels["revision"])
    assert all(labels[name] for name in ("title", "description", "licenses", "base.name"))


def test_image_is_of_a_bounded_size(container):
    files = (path for path in container.root.rglob("*") if path.is_file() and not path.is_symlink())
    size = sum(path.stat().st_size for path in files)
    assert size < MAX_BYTES, f"{IMAGE} has {size / 1e6:.0f} MB"


def components(container, name):
    """The components of one of the image's bills of materials, by their names."""
    bill = json.loads((container.root / "opt/ultragray/sbom" / f"{name}.cdx.json").read_text())
    assert bill["bomFormat"] == "CycloneDX"
    return {component["name"]: component for component in bill["components"]}


def licences(component):
    found = component.get("licenses", [])
    return " ".join(
        str(one.get("expression") or one["license"].get("id") or one["license"].get("name")) for one in found
    )


DISTRIBUTIONS = "import importlib.metadata as m; print(*(d.name for d in m.distributions()))"


@pytest.mark.parametrize(
    ("bill", "listing"),
    [
        ("python", ["python", "-c", DISTRIBUTIONS]),
        ("console", ["echo", "svelte three"]),
        ("debian", ["dpkg-query", "--show", "--showformat", "${Package}\n"]),
    ],
)
def test_a_bill_of_materials_names_everything_with_a_licence_that_permits_its_use(container, bill, listing):
    named = {name.lower(): licences(part) for name, part in components(container, bill).items()}
    named.pop("ultragray-console", None)  # the project's own
    listed = {name.lower() for name in container.run(*listing).stdout.split()}
    assert listed <= set(named)
    if bill == "debian":  # each has one, of whatever kind
        assert {name for name in listed if not named[name]} <= IN_WORDS_ALONE
    else:
        assert {name for name, told in named.items() if not PERMISSIVE.search(told)} <= IN_WORDS_ALONE
