"""The wheels, as they are built and installed by somebody who has no checkout and no compiler.

What they need of others is borrowed from the environment of the tests instead of downloaded.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import urllib.request
import venv
import zipfile
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch

from ..surroundings import ROOT
from .projects import FOLDERS, packages, unpacked

pytestmark = pytest.mark.long

CONSOLE_PAGE = "service/ultragray_service/console/index.html"
RENDERING = """
import sys
import numpy as np
from ultragray_client import Client
with Client(sys.argv[1]) as client:
    print(client.render("demo", np.eye(4))["bmode"].shape)
"""


def run(command, cwd, **environment):
    shown = [str(part) for part in command]
    ours = {name: value for name, value in os.environ.items() if name != "SSL_CERT_FILE"}  # what builds is downloaded
    return subprocess.run(shown, cwd=cwd, env=ours | environment, capture_output=True, text=True, timeout=900)


def succeeds(command, cwd, **environment):
    done = run(command, cwd, **environment)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A folder with the sdists and wheels of all four projects, each wheel built from its sdist."""
    if not (ROOT / CONSOLE_PAGE).is_file():
        pytest.skip("a wheel holds the console, and that is not built: make console")
    output = tmp_path_factory.mktemp("dist")
    for folder in FOLDERS.values():
        succeeds([sys.executable, "-m", "build", "--outdir", output, folder], output)
    return output


def wheel_of(built, name):
    (found,) = built.glob(f"{name.replace('-', '_')}-*.whl")
    return found


@pytest.fixture(scope="session")
def libraries(tmp_path_factory):
    """A folder with links to all that is installed beside torch, but for what is ours."""
    folder = tmp_path_factory.mktemp("libraries")
    for path in Path(torch.__file__).parents[1].iterdir():
        if "ultragray" not in path.name and path.suffix != ".pth":
            (folder / path.name).symlink_to(path)
    return folder


class Environment:
    """A virtual environment that sees `libraries`, and has pip from there."""

    def __init__(self, folder, libraries):
        venv.create(folder, with_pip=False, symlinks=True)
        self.folder, self.python = folder, folder / "bin" / "python"
        (self.site,) = folder.glob("lib/python3*/site-packages")
        (self.site / "libraries.pth").write_text(f"{libraries}\n")

    def pip(self, *arguments):
        succeeds([self.python, "-m", "pip", *arguments], self.folder)

    def install(self, *wheels):
        self.pip("install", "--no-deps", "--no-index", *wheels)

    def uninstall(self, name):
        self.pip("uninstall", "--yes", name)

    def ours(self):
        return {path.name for path in self.site.glob("ultragray*") if not path.name.endswith(".dist-info")}


@pytest.fixture
def environment(tmp_path, libraries):
    return Environment(tmp_path / "environment", libraries)


@contextmanager
def serving(environment, folder):
    """`ultragray serve` in an empty folder, with a PATH on which there is no compiler; its HTTP and gRPC addresses."""
    command = [environment.folder / "bin" / "ultragray", "serve", "--http-port", "0", "--grpc-port", "0"]
    surroundings = {**os.environ, "PATH": str(environment.folder / "bin")}
    with subprocess.Popen(
        command, cwd=folder, env=surroundings, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as service:
        try:
            assert service.stdout is not None
            lines = []
            for line in service.stdout:
                lines.append(line)
                http, grpc = re.search(r"http://127\.0\.0\.1:\d+", line), re.search(r"gRPC on ([\w.]+:\d+)", line)
                if http and grpc:
                    yield http[0], grpc[1]
                    break
            else:
                pytest.fail("".join(lines))
        finally:
            service.terminate()


def test_a_wheel_holds_its_packages_the_kernel_and_the_console(built):
    with zipfile.ZipFile(wheel_of(built, "ultragray")) as wheel:
        names = wheel.namelist()
    assert {name.partition("/")[0] for name in names if ".dist-info/" not in name} == set(packages("ultragray"))
    assert "ultragray_service/console/index.html" in names
    assert [name for name in names if re.fullmatch(r"ultragray/_cpu\.[^/]*\.so", name)] != []
    for package in packages("ultragray"):
        (start,) = ROOT.glob(f"*/{package}/__init__.py")
        sources = {path.relative_to(start.parents[1]).as_posix() for path in start.parent.rglob("*.py")}
        assert sources <= set(names)


def test_an_sdist_without_the_console_builds_nothing(built, tmp_path):
    (sdist,) = built.glob("ultragray-*.tar.gz")
    source = unpacked(sdist, tmp_path / "source")
    shutil.rmtree((source / CONSOLE_PAGE).parent)
    for kind in ("--sdist", "--wheel"):
        done = run([sys.executable, "-m", "build", kind, "--outdir", tmp_path / "dist", source], tmp_path)
        assert done.returncode != 0
        (said,) = re.findall(r"^error: .*", done.stdout + done.stderr, flags=re.MULTILINE)
        assert "the console is not built" in said
        assert "Traceback" not in done.stdout + done.stderr
    assert not (tmp_path / "dist").exists()


def test_the_core_alone_renders_a_frame(built, environment, tmp_path):
    environment.install(wheel_of(built, "ultragray"))
    said = succeeds([environment.python, ROOT / "distribution/render_a_frame.py"], tmp_path, PATH=str(tmp_path))
    assert "its first frame rendered" in said


def test_a_service_of_wheels_shows_console_and_demo_scene(built, environment, libraries, tmp_path, working_folder):
    environment.install(wheel_of(built, "ultragray"), wheel_of(built, "ultragray-proto"))
    client = Environment(tmp_path / "client", libraries)
    client.install(wheel_of(built, "ultragray-client"), wheel_of(built, "ultragray-proto"))
    with serving(environment, working_folder) as (http, grpc):
        with urllib.request.urlopen(f"{http}/", timeout=300) as answer:
            assert b"/assets/" in answer.read()  # the page that says how to build the console has none
        with urllib.request.urlopen(f"{http}/v1/scenes", timeout=300) as answer:
            assert [scene["name"] for scene in json.load(answer)["scenes"]] == ["demo"]
        assert succeeds([client.python, "-c", RENDERING, grpc], tmp_path) == "(256, 256)\n"


def test_removing_one_leaves_the_other_working(built, environment, libraries, tmp_path, working_folder):
    wheels = [wheel_of(built, name) for name in FOLDERS]
    environment.install(*wheels)
    environment.uninstall("ultragray-client")
    assert environment.ours() == _packages_without("ultragray-client")
    with serving(environment, working_folder) as (_, grpc):
        client = Environment(tmp_path / "client", libraries)
        client.install(*wheels)
        client.uninstall("ultragray")
        assert client.ours() == _packages_without("ultragray")
        assert succeeds([client.python, "-c", RENDERING, grpc], tmp_path) == "(256, 256)\n"


def _packages_without(removed):
    """The import packages of all distributions but one."""
    return {package for name in FOLDERS if name != removed for package in packages(name)}
