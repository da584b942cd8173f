"""3D Slicer as a peer: the scene file that `ultragray slicer` writes, and the messages that its connector exchanges.

3D Slicer itself is not run. Its connector is played by pyigtl, by what the scene file says: on connecting it sends a
STATUS with metadata, so that headers of version 2 are understood, then the nodes to push, then commands.
"""

import json
from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np
import pytest

from ultragray.scene.info import read_header

from ..cli.command_line import refused, run
from ..conftest import make_scene
from .conftest import address_of


@dataclass(frozen=True)
class Opened:
    """A scene file as 3D Slicer reads it: its nodes by id, each with the name of its element."""

    nodes: dict[str, tuple[str, dict[str, str]]]

    def node(self, tag):
        [found] = [values for name, values in self.nodes.values() if name == tag]
        return found

    def references(self, tag):
        text = self.node(tag).get("references", "")
        return {role: ids.split() for role, ids in (one.split(":") for one in text.split(";") if one)}

    def attributes(self, tag):
        return dict(one.split(":", 1) for one in self.node(tag)["attributes"].split(";"))

    @property
    def pose(self):
        numbers = self.node("LinearTransform")["matrixTransformToParent"].split()
        return np.array(numbers, np.float64).reshape(4, 4)


def open_scene(path):
    root = ElementTree.fromstring(path.read_text(encoding="utf-8"))
    assert root.tag == "MRML"
    nodes = {node.get("id", ""): (node.tag, dict(node.attrib)) for node in root}
    assert len(nodes) == len(root)
    return Opened(nodes)


@pytest.fixture
def written(igtl_service, igtl_folder, tmp_path):
    """What `ultragray slicer` writes for the scene `demo` and the running service."""
    arguments = ("slicer", igtl_folder / "demo.ugr", "-o", tmp_path / "demo.mrml", "--spacing-mm", 2)
    result = run(*arguments, "--igtl-address", address_of(igtl_service), "--json")
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert (document["device"], document["image"]) == ("ProbeTodemo", "Image_demo")
    return open_scene(tmp_path / "demo.mrml")


def test_the_connector_resumes_and_pushes_the_pose_of_a_training_view(written, igtl_service, igtl_folder):
    connector = written.node("IGTLConnector")
    assert (connector["connectorType"], connector["persistent"], connector["state"]) == ("CLIENT", "1", "1")
    assert f"{connector['serverHostname']}:{connector['serverPort']}" == address_of(igtl_service)
    assert written.attributes("LinearTransform")["OpenIGTLinkIF.pushOnConnect"] == "true"
    poses = read_header(igtl_folder / "demo.ugr").training_poses
    np.testing.assert_array_equal(written.pose, poses[len(poses) // 2])


def test_what_cannot_be_written_is_told_before_the_work(tmp_path):
    make_scene(20).save(tmp_path / "one.ugr")
    scene, output = tmp_path / "one.ugr", tmp_path / "one.mrml"
    assert "must end in .mrml" in refused("slicer", scene, "-o", tmp_path / "one.xml")
    for address in ("host", "host:0", "host:99999", "a b:1", ":18944"):
        told = refused("slicer", scene, "-o", output, "--igtl-address", address)
        assert "must be HOST:PORT such as 127.0.0.1:18944" in told
    (tmp_path / "one-echo.nii.gz").touch()
    assert "--force" in refused("slicer", scene, "-o", output)
    assert not output.exists()
    assert run("slicer", scene, "-o", output, "--igtl-address", "[::1]:18944", "--force").exit_code == 0
    assert open_scene(output).node("IGTLConnector")["serverHostname"] == "::1"
    assert open_scene(output).pose.tolist() == make_scene(20).training_poses[2].tolist()
