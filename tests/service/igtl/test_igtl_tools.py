"""Tools over OpenIGTLink: set by a command, moved by the device of a tracker, through pyigtl and as bytes."""

from __future__ import annotations

import json
import math
from typing import Any

import cv2
import numpy as np
import pyigtl
import pytest

from ultragray.contract import from_dict
from ultragray.geometry.probe import FloatArray
from ultragray.rendering.tools import MAX_TOOLS, Needle, Tool
from ultragray_client import Client, RenderSettings
from ultragray_client.contract import Box as ClientBox
from ultragray_client.contract import Needle as ClientNeedle
from ultragray_service.igtl.contents import Instrument, pack_instruments, unpack_image

from ..conftest import RunningService
from .conftest import Peer, address_of, moved, pyigtl_client
from .test_igtl_commands import ask, command, set_to, value_of

NEEDLE = {"kind": "needle", "tip_mm": [0, 0, 0], "hub_mm": [-30, 0, -10], "diameter_mm": 1.5}
TRACKED = json.dumps([{**NEEDLE, "device": "NeedleToReference"}])


def at(x_mm: float, z_mm: float, turn_deg: float = 0.0) -> FloatArray:  # [4, 4] mm, turned about y
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.radians([0.0, turn_deg, 0.0]))[0]
    pose[:3, 3] = (x_mm, 0.0, z_mm)
    return pose


def with_tools(service: RunningService, *tools: Any, scene: str = "demo", pose: Any = None) -> Any:  # [H, W]
    """The pixels of a frame with tools that lie in the scene, over gRPC."""
    with Client(service.grpc, timeout_s=60.0) as client:
        frame = client.render(scene, np.eye(4) if pose is None else pose, RenderSettings(tools=tools))
    return frame["bmode"]


def needle_at(pose: FloatArray) -> ClientNeedle:
    ends = (pose[:3, :3] @ np.array(NEEDLE[end], float) + pose[:3, 3] for end in ("tip_mm", "hub_mm"))
    tip_mm, hub_mm = (tuple(end.tolist()) for end in ends)
    return ClientNeedle(tip_mm=tip_mm, hub_mm=hub_mm, diameter_mm=1.5)


def test_pyigtl_moves_a_needle_and_the_probe_stays(igtl_service: RunningService) -> None:
    with pyigtl_client(address_of(igtl_service)) as client:
        text = command("SetUsParameter", ("Tools", TRACKED))
        client.send_message(pyigtl.StringMessage(text, device_name="CMD_1"))
        assert 'Status="SUCCESS"' in client.wait_for_message("ACK_1", timeout=60).string
        client.send_message(pyigtl.TransformMessage(np.eye(4), device_name="ProbeToReference"))
        without = client.wait_for_message("Image_Reference", timeout=60).image[0]
        frames = []
        for place in (at(3.0, 20.0), at(-4.0, 26.0, 30.0)):
            client.send_message(pyigtl.TransformMessage(place, device_name="NeedleToReference"))
            frames.append(client.wait_for_message("Image_Reference", timeout=60).image[0])
    assert np.array_equal(without, with_tools(igtl_service))
    for frame, place in zip(frames, (at(3.0, 20.0), at(-4.0, 26.0, 30.0)), strict=True):
        expected = with_tools(igtl_service, needle_at(place.astype(np.float32).astype(float)))
        np.testing.assert_allclose(frame.astype(int), expected, atol=1)
        assert (np.abs(frame.astype(int) - without) > 20).sum() > 10  # it is seen


def test_frames_tell_their_tools_and_go_by_the_pose_before(peer: Peer) -> None:
    set_to(peer, Tools=TRACKED)
    peer.send_pose(at(3.0, 20.0), "NeedleToReference")  # no pose of a probe yet: no answer
    peer.send_pose(moved(1), "ProbeToReference", version=2, timestamp=5)
    first = peer.receive()
    (needle,) = json.loads(first.metadata["tools"])
    assert (needle["tip_mm"], needle["hub_mm"]) == ([3.0, 0.0, 20.0], [-27.0, 0.0, 10.0])
    peer.send_pose(at(4.0, 20.0), "NeedleToReference", version=2, timestamp=7, message_id=9)
    second = peer.receive()
    assert (second.device_name, second.timestamp, second.message_id) == ("Image_Reference", 7, 9)
    assert json.loads(second.metadata["tools"])[0]["tip_mm"] == [4.0, 0.0, 20.0]
    np.testing.assert_array_equal(unpack_image(second.content).matrix, unpack_image(first.content).matrix)


def test_probe_and_needle_in_one_message_give_one_frame(peer: Peer, igtl_service: RunningService) -> None:
    set_to(peer, Tools=TRACKED)
    instruments = [Instrument("NeedleToReference", at(2.0, 18.0)), Instrument("ProbeToReference", moved(1))]
    peer.send("TDATA", "Tracker", pack_instruments("TDATA", instruments))
    image = peer.image()
    expected = with_tools(igtl_service, needle_at(at(2.0, 18.0)), pose=moved(1))
    np.testing.assert_allclose(image.pixels.astype(int), expected, atol=1)
    assert peer.ask("GET_STATUS").type_name == "STATUS"  # no second image came before


@pytest.mark.parametrize("lost", [0.0, math.nan])
def test_frames_go_on_while_the_tracker_does_not_see_the_needle(peer: Peer, lost: float) -> None:
    set_to(peer, Tools=TRACKED)
    for step, needle in enumerate((at(2.0, 18.0), np.full((4, 4), lost), at(5.0, 18.0))):
        instruments = [Instrument("NeedleToReference", needle), Instrument("ProbeToReference", moved(step))]
        peer.send("TDATA", "Tracker", pack_instruments("TDATA", instruments), version=2)
        frame = peer.receive()
        assert frame.type_name == "IMAGE"
        corner_x = float(unpack_image(frame.content).matrix[0, 3])
        assert corner_x == pytest.approx(step - 20.0 * 47 / 48, abs=1e-3)
        tip_x = json.loads(frame.metadata["tools"])[0]["tip_mm"][0]
        assert tip_x == (5.0 if step == 2 else 2.0)  # where it was last seen


def test_the_last_frame_of_a_needle_that_is_moved_fast_has_its_last_place(peer: Peer) -> None:
    set_to(peer, Tools=TRACKED)
    peer.send_pose(at(0.0, 20.0), "NeedleToReference", version=2)
    for step in range(40):
        peer.send_pose(moved(0.1 * step), "ProbeToReference", version=2)
        peer.send_pose(at(0.25 * step, 20.0), "NeedleToReference", version=2)
    tips, corner_x = [-1.0], math.inf
    while tips[-1] < 9.75 or abs(corner_x - (3.9 - 20.0 * 47 / 48)) > 1e-3:  # the probe may be the one that lags
        frame = peer.receive()
        assert frame.type_name == "IMAGE"
        tips.append(json.loads(frame.metadata["tools"])[0]["tip_mm"][0])
        corner_x = float(unpack_image(frame.content).matrix[0, 3])
    assert tips == sorted(tips)


def test_tools_that_no_device_moves_stay_where_they_are(peer: Peer, igtl_service: RunningService) -> None:
    box = {"kind": "box", "centre_mm": [0.0, 0.0, 25.0], "size_mm": [8.0, 8.0, 4.0]}
    set_to(peer, Tools=json.dumps([box, {**box, "frame": "probe", "centre_mm": [8.0, 0.0, 10.0]}]))
    peer.send_pose(moved(2), "ProbeToReference")
    sizes = {"size_mm": (8.0, 8.0, 4.0)}
    there = ClientBox(centre_mm=(0.0, 0.0, 25.0), **sizes), ClientBox(centre_mm=(10.0, 0.0, 10.0), **sizes)
    np.testing.assert_allclose(peer.image().pixels.astype(int), with_tools(igtl_service, *there, pose=moved(2)), atol=1)


def test_tools_are_told_as_they_were_set_and_keep_their_place_when_they_are_set_again(peer: Peer) -> None:
    set_to(peer, Tools=TRACKED)
    (told,) = json.loads(str(value_of(peer, "Tools")))
    assert (told.pop("device"), "frame" in told) == ("NeedleToReference", False)
    assert from_dict(Tool, told) == Needle(tip_mm=(0, 0, 0), hub_mm=(-30, 0, -10), diameter_mm=1.5)
    peer.send_pose(at(3.0, 20.0), "NeedleToReference")
    set_to(peer, Tools=json.dumps([{**NEEDLE, "brightness": 0.5, "device": "NeedleToReference"}]))
    peer.send_pose(np.eye(4), "ProbeToReference", version=2)
    (needle,) = json.loads(peer.receive().metadata["tools"])
    assert (needle["tip_mm"], needle["brightness"]) == ([3.0, 0.0, 20.0], 0.5)
    set_to(peer, Tools="[]")
    peer.send_pose(np.eye(4), "ProbeToReference", version=2)
    assert "tools" not in peer.receive().metadata


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ("needle", "must be a list in JSON"),
        ('{"kind": "needle"}', "must be a list in JSON"),
        ('[{"kind": "spoon"}]', "[0].kind must be one of"),
        ('[{"kind": "needle", "tip_mm": [0, 0, 0]}]', "hub_mm is required"),
        (json.dumps([{**NEEDLE, "device": ""}]), "device must be the name of one, of 1 to 20 bytes, got ''"),
        (json.dumps([{**NEEDLE, "device": "N" * 21}]), "of 1 to 20 bytes"),
        (json.dumps([{**NEEDLE, "device": "N", "frame": "scene"}]), "frame stands in place of device"),
        (json.dumps([{"kind": "needle", "tip_mm": [0, 0, 0], "hub_mm": [0, 0, 9]}] * (MAX_TOOLS + 1)), "at most 8"),
    ],
)
def test_what_is_no_tool_is_refused_and_those_before_stay(peer: Peer, value: str, text: str) -> None:
    set_to(peer, Tools=TRACKED)
    reply = ask(peer, command("SetUsParameter", ("Tools", value)))
    assert reply.get("Status") == "FAIL"
    assert text in str(reply.get("Error"))
    assert len(json.loads(str(value_of(peer, "Tools")))) == 1
