"""Tools and registrations over OpenIGTLink: set by a command, moved by the devices of a tracker."""

import json
import math

import cv2
import numpy as np
import pyigtl
import pytest

from ultragray.contract import from_dict
from ultragray.rendering.tools import Needle, Tool
from ultragray_client import Client, RenderSettings
from ultragray_client.contract import Needle as ClientNeedle
from ultragray_service.igtl.contents import NOT_FOUND, Instrument, pack_instruments, unpack_image, unpack_transform

from .conftest import Peer, address_of, moved, pyigtl_client
from .test_igtl_commands import ask, command, set_to, value_of
from .test_igtl_server import over_grpc

NEEDLE = {"kind": "needle", "tip_mm": [0, 0, 0], "hub_mm": [-30, 0, -10], "diameter_mm": 1.5}
TRACKED = json.dumps([{**NEEDLE, "device": "NeedleToReference"}])


def placed(x_mm, z_mm, turn_deg=0.0):  # [4, 4] mm, turned about y
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.radians([0.0, turn_deg, 0.0]))[0]
    pose[:3, 3] = (x_mm, 0.0, z_mm)
    return pose


def with_tools(service, *tools, scene="demo", pose=None):  # [H, W]
    """The pixels of a frame with tools that lie in the scene, over gRPC."""
    with Client(service.grpc, timeout_s=300.0) as client:
        frame = client.render(scene, np.eye(4) if pose is None else pose, RenderSettings(tools=tools))
    return frame["bmode"]


def needle_at(pose):
    ends = (pose[:3, :3] @ np.array(NEEDLE[end], float) + pose[:3, 3] for end in ("tip_mm", "hub_mm"))
    tip_mm, hub_mm = (tuple(end.tolist()) for end in ends)
    return ClientNeedle(tip_mm=tip_mm, hub_mm=hub_mm, diameter_mm=1.5)


def test_frames_tell_their_tools_and_go_by_the_pose_before(peer):
    set_to(peer, Tools=TRACKED)
    peer.send_pose(placed(3.0, 20.0), "NeedleToReference")  # no pose of a probe yet: no answer
    peer.send_pose(moved(1), "ProbeToReference", version=2, timestamp=5)
    first = peer.receive()
    (needle,) = json.loads(first.metadata["tools"])
    assert (needle["tip_mm"], needle["hub_mm"]) == ([3.0, 0.0, 20.0], [-27.0, 0.0, 10.0])
    peer.send_pose(placed(4.0, 20.0), "NeedleToReference", version=2, timestamp=7, message_id=9)
    second = peer.receive()
    assert (second.device_name, second.timestamp, second.message_id) == ("Image_Reference", 7, 9)
    assert json.loads(second.metadata["tools"])[0]["tip_mm"] == [4.0, 0.0, 20.0]
    np.testing.assert_array_equal(unpack_image(second.content).matrix, unpack_image(first.content).matrix)


def test_probe_and_needle_in_one_message_give_one_frame(peer, igtl_service):
    set_to(peer, Tools=TRACKED)
    instruments = [Instrument("NeedleToReference", placed(2.0, 18.0)), Instrument("ProbeToReference", moved(1))]
    peer.send("TDATA", "Tracker", pack_instruments("TDATA", instruments))
    image = peer.image()
    expected = with_tools(igtl_service, needle_at(placed(2.0, 18.0)), pose=moved(1))
    np.testing.assert_allclose(image.pixels.astype(int), expected, atol=1)
    assert peer.ask("GET_STATUS").type_name == "STATUS"  # no second image came before


@pytest.mark.parametrize("lost", [0.0, math.nan])
def test_frames_go_on_while_the_tracker_does_not_see_the_needle(peer, lost):
    set_to(peer, Tools=TRACKED)
    for step, needle in enumerate((placed(2.0, 18.0), np.full((4, 4), lost), placed(5.0, 18.0))):
        instruments = [Instrument("NeedleToReference", needle), Instrument("ProbeToReference", moved(step))]
        peer.send("TDATA", "Tracker", pack_instruments("TDATA", instruments), version=2)
        frame = peer.receive()
        assert frame.type_name == "IMAGE"
        corner_x = float(unpack_image(frame.content).matrix[0, 3])
        assert corner_x == pytest.approx(step - 20.0 * 47 / 48, abs=1e-3)
        tip_x = json.loads(frame.metadata["tools"])[0]["tip_mm"][0]
        assert tip_x == (5.0 if step == 2 else 2.0)  # where it was last seen


def test_the_last_frame_of_a_needle_that_is_moved_fast_has_its_last_place(peer):
    set_to(peer, Tools=TRACKED)
    peer.send_pose(placed(0.0, 20.0), "NeedleToReference", version=2)
    for step in range(40):
        peer.send_pose(moved(0.1 * step), "ProbeToReference", version=2)
        peer.send_pose(placed(0.25 * step, 20.0), "NeedleToReference", version=2)
    tips, corner_x = [-1.0], math.inf
    while tips[-1] < 9.75 or abs(corner_x - (3.9 - 20.0 * 47 / 48)) > 1e-3:  # the probe may be the one that lags
        frame = peer.receive()
        assert frame.type_name == "IMAGE"
        tips.append(json.loads(frame.metadata["tools"])[0]["tip_mm"][0])
        corner_x = float(unpack_image(frame.content).matrix[0, 3])
    assert tips == sorted(tips)


def test_tools_are_told_as_they_were_set_and_keep_their_place_when_they_are_set_again(peer):
    set_to(peer, Tools=TRACKED)
    (told,) = json.loads(str(value_of(peer, "Tools")))
    assert (told.pop("device"), "frame" in told) == ("NeedleToReference", False)
    assert from_dict(Tool, told) == Needle(tip_mm=(0, 0, 0), hub_mm=(-30, 0, -10), diameter_mm=1.5)
    peer.send_pose(placed(3.0, 20.0), "NeedleToReference")
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
        ('[{"kind": "spoon"}]', "[0].kind must be one of"),
        (json.dumps([{**NEEDLE, "device": "N" * 21}]), "of 1 to 20 bytes"),
        (json.dumps([{**NEEDLE, "device": "N", "frame": "scene"}]), "frame stands in place of device"),
    ],
)
def test_what_is_no_tool_is_refused_and_those_before_stay(peer, value, text):
    set_to(peer, Tools=TRACKED)
    reply = ask(peer, command("SetUsParameter", ("Tools", value)))
    assert reply.get("Status") == "FAIL"
    assert text in str(reply.get("Error"))
    assert len(json.loads(str(value_of(peer, "Tools")))) == 1


POSE = moved(1)  # of the probe in the scene


def motion(seed):
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(rng.normal(size=3))[0]
    pose[:3, 3] = 50.0 * rng.normal(size=3)
    return pose


TRACKER_TO_SCENE, PROBE_TO_MARKER = motion(0), motion(1)
MARKER_TO_TRACKER = np.linalg.inv(TRACKER_TO_SCENE) @ POSE @ np.linalg.inv(PROBE_TO_MARKER)


@pytest.fixture(scope="module")
def service(start_service, artifacts):
    """Tracks by `tracker` unless a client says otherwise."""
    folder = artifacts
    service = start_service(artifact_folder=folder, igtl_port=0, igtl_scene="demo", igtl_registration="tracker")
    with Client(service.grpc, timeout_s=300.0) as client:
        client.registrations.put("tracker", "demo", TRACKER_TO_SCENE, PROBE_TO_MARKER)
        client.registrations.put("plain", "second", np.eye(4))
    return service


@pytest.fixture
def tracked(service):
    one = Peer(address_of(service))
    yield one
    one.socket.close()


def test_pyigtl_tracks_a_probe_and_gets_the_frame_in_the_frame_of_the_tracker(service):
    with pyigtl_client(address_of(service)) as client:
        client.send_message(pyigtl.TransformMessage(MARKER_TO_TRACKER, device_name="ProbeToTracker"))
        image = client.wait_for_message("Image_Tracker", timeout=300)
    expected = over_grpc(service, "demo", POSE)
    np.testing.assert_allclose(image.image[0].astype(int), expected, atol=2)  # TRANSFORM has 24 bits
    first = np.array([-20.0 + 20.0 / 48, 0.0, 0.0, 1.0])  # the first pixel in the probe
    in_scene = TRACKER_TO_SCENE @ image.ijk_to_world_matrix @ [0.0, 0.0, 0.0, 1.0]
    np.testing.assert_allclose(in_scene[0], (POSE @ first)[0], atol=1e-3)


def test_a_frame_tells_what_led_it_and_its_pose_in_both_frames(tracked):
    assert tracked.ask("STT_TRANSFOR", "", version=2).type_name == "RTS_TRANSFOR"
    tracked.send_pose(MARKER_TO_TRACKER, "ProbeToTracker", version=2)
    messages = {message.type_name: message for message in (tracked.receive(), tracked.receive())}
    metadata = messages["IMAGE"].metadata
    assert metadata["registration"] == "tracker"
    np.testing.assert_allclose(json.loads(metadata["probe_to_scene"]), POSE, atol=1e-4)
    np.testing.assert_allclose(unpack_transform(messages["TRANSFORM"].content), MARKER_TO_TRACKER, atol=1e-4)


def test_a_needle_is_led_from_the_frame_of_the_tracker(tracked):
    needle = {"kind": "needle", "tip_mm": [0, 0, 0], "hub_mm": [-30, 0, -10], "device": "NeedleToTracker"}
    set_to(tracked, Tools=json.dumps([needle]))
    tracked.send_pose(np.linalg.inv(TRACKER_TO_SCENE) @ moved(5), "NeedleToTracker")
    tracked.send_pose(MARKER_TO_TRACKER, "ProbeToTracker", version=2)
    (told,) = json.loads(tracked.receive().metadata["tools"])
    np.testing.assert_allclose(told["tip_mm"], [5.0, 0.0, 0.0], atol=1e-4)
    np.testing.assert_allclose(told["hub_mm"], [-25.0, 0.0, -10.0], atol=1e-4)


def test_a_client_chooses_another_registration_with_its_scene_or_none(tracked):
    assert value_of(tracked, "Registration") == "tracker"
    set_to(tracked, Registration="plain")
    tracked.send_pose(moved(2), "ProbeToTracker", version=2)
    metadata = tracked.receive().metadata
    assert (metadata["scene"], metadata["registration"]) == ("second", "plain")
    set_to(tracked, Registration="", Scene="demo")
    tracked.send_pose(moved(2), "ProbeToTracker", version=2)
    answer = tracked.receive()
    assert "registration" not in answer.metadata
    np.testing.assert_allclose(unpack_image(answer.content).matrix[0, 3], 2.0 - 20.0 + 20.0 / 48, atol=1e-3)


def test_a_registration_that_is_not_there_or_of_another_scene_is_told(tracked, service):
    reply = ask(tracked, command("SetUsParameter", ("Registration", "nobody")))
    assert "there is no registration 'nobody'" in str(reply.get("Error"))
    tracked.send_pose(MARKER_TO_TRACKER, "ProbeTosecond")
    assert "registration must be one of the scene 'second'" in tracked.status().text
    with Client(service.grpc, timeout_s=300.0) as client:
        client.registrations.put("brief", "demo", np.eye(4))
        set_to(tracked, Registration="brief")
        client.registrations.delete("brief")
    tracked.send_pose(MARKER_TO_TRACKER, "ProbeToTracker")
    assert tracked.status().code == NOT_FOUND
