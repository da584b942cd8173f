"""The wheels and sdists of client, messages, node and studies: each holds its own package, and what ROS looks for."""

import subprocess
import sys
import zipfile

import pytest

from ..surroundings import ROOT
from .projects import unpacked

PACKAGES = {
    "client": "ultragray_client",
    "proto": "ultragray_proto",
    "ros": "ultragray_ros",
    "studies": "ultragray_studies",
}
FOR_ROS = {
    "share/ament_index/resource_index/packages/ultragray_ros",
    "share/ultragray_ros/foxglove/ultragray.json",
    "share/ultragray_ros/launch/ultragray.launch.xml",
    "share/ultragray_ros/package.xml",
}


def sources(folder):
    files = (path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    return {path.relative_to(folder.parent).as_posix() for path in files}


def build(folder, target, output):
    command = [sys.executable, "-m", "hatchling", "build", "-t", target, "-d", str(output)]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    return next(output.iterdir())


@pytest.mark.parametrize("project", PACKAGES)
def test_a_wheel_of_the_sdist_holds_its_package_the_licence_and_what_ros_looks_for(project, tmp_path):
    source = unpacked(build(ROOT / project, "sdist", tmp_path / "sdist"), tmp_path / "source")
    with zipfile.ZipFile(build(source, "wheel", tmp_path / "wheel")) as wheel:
        about = {name for name in wheel.namelist() if ".dist-info/" in name or ".data/data/" in name}
        (licence,) = (wheel.read(name) for name in about if name.endswith("/licenses/LICENSE"))
        assert set(wheel.namelist()) - about == sources(ROOT / project / PACKAGES[project])
    assert licence == (ROOT / "LICENSE").read_bytes()
    installed = {name.partition(".data/data/")[2] for name in about if ".data/data/" in name}
    assert installed == (FOR_ROS if project == "ros" else set())
    if project == "proto":  # what other languages generate their stubs from
        assert {path.name for path in ROOT.glob("proto/ultragray/v1/*.proto")} == {
            path.name for path in source.rglob("*.proto")
        }
