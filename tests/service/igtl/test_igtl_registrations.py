"""Poses in the frame of a tracker over OpenIGTLink: by a command, and by the service's setting, through pyigtl."""

from __future__ import annotations

import json
from collections.abc import Iterator

import cv2
import numpy as np
import pyigtl
import pytest

from ultragray.geometry.probe import FloatArray
from ultragray_client import Client
from ultragray_service.igtl.contents import NOT_FOUND, unpack_image, unpack_transform

from ..conftest import RunningService, StartService
from .conftest import Peer, address_of, moved, pyigtl_client
from .test_igtl_commands import ask, command, set_to, value_of
from .test_igtl_server import over_grpc

POSE = moved(1)  # of the probe in the scene


def motion(seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(rng.normal(size=3))[0]
    pose[:3, 3] = 50.0 * rng.normal(size=3)
    return pose


TRACKER_TO_SCENE, PROBE_TO_MARKER = motion(0), motion(1)
MARKER_TO_TRACKER = np.linalg.inv(TRACKER_TO_SCENE) @ POSE @ np.linalg.inv(PROBE_TO_MARKER)


@pytest.fixture(scope="module")
def service(start_service: StartService, tmp_path_factory: pytest.TempPathFactory) -> RunningService:
    """Tracks by `tracker` unless a client says otherwise."""
    folder = tmp_path_factory.mktemp("artifacts")
    service = start_service(artifact_folder=folder, igtl_port=0, igtl_scene="demo", igtl_registration="tracker")
    with Client(service.grpc, timeout_s=60.0) as client:
        client.registrations.put("tracker", "demo", TRACKER_TO_SCENE, PROBE_TO_MARKER)
        client.registrations.put("plain", "second", np.eye(4))
    return service


@pytest.fixture
def peer(service: RunningService) -> Iterator[Peer]:
    one = Peer(address_of(service))
    yield one
    one.socket.close()


def test_pyigtl_tracks_a_probe_and_gets_the_frame_in_the_frame_of_the_tracker(service: RunningService) -> None:
    with pyigtl_client(address_of(service)) as client:
        client.send_message(pyigtl.TransformMessage(MARKER_TO_TRACKER, device_name="ProbeToTracker"))
        image = client.wait_for_message("Image_Tracker", timeout=60)
    expected = over_grpc(service, "demo", POSE)
    np.testing.assert_allclose(image.image[0].astype(int), expected, atol=2)  # TRANSFORM has 24 bits
    first = np.array([-20.0 + 20.0 / 48, 0.0, 0.0, 1.0])  # the first pixel in the probe
    in_scene = TRACKER_TO_SCENE @ image.ijk_to_world_matrix @ [0.0, 0.0, 0.0, 1.0]
    np.testing.assert_allclose(in_scene[0], (POSE @ first)[0], atol=1e-3)


def test_a_frame_tells_what_led_it_and_its_pose_in_both_frames(peer: Peer) -> None:
    assert peer.ask("STT_TRANSFOR", "", version=2).type_name == "RTS_TRANSFOR"
    peer.send_pose(MARKER_TO_TRACKER, "ProbeToTracker", version=2)
    messages = {message.type_name: message for message in (peer.receive(), peer.receive())}
    metadata = messages["IMAGE"].metadata
    assert metadata["registration"] == "tracker"
    np.testing.assert_allclose(json.loads(metadata["probe_to_scene"]), POSE, atol=1e-4)
    np.testing.assert_allclose(unpack_transform(messages["TRANSFORM"].content), MARKER_TO_TRACKER, atol=1e-4)


def test_a_needle_is_led_from_the_frame_of_the_tracker(peer: Peer) -> None:
    needle = {"kind": "needle", "tip_mm": [0, 0, 0], "hub_mm": [-30, 0, -10], "device": "NeedleToTracker"}
    set_to(peer, Tools=json.dumps([needle]))
    peer.send_pose(np.linalg.inv(TRACKER_TO_SCENE) @ moved(5), "NeedleToTracker")
    peer.send_pose(MARKER_TO_TRACKER, "ProbeToTracker", version=2)
    (told,) = json.loads(peer.receive().metadata["tools"])
    np.testing.assert_allclose(told["tip_mm"], [5.0, 0.0, 0.0], atol=1e-4)
    np.testing.assert_allclose(told["hub_mm"], [-25.0, 0.0, -10.0], atol=1e-4)


def test_a_client_chooses_another_registration_with_its_scene_or_none(peer: Peer) -> None:
    assert value_of(peer, "Registration") == "tracker"
    set_to(peer, Registration="plain")
    peer.send_pose(moved(2), "ProbeToTracker", version=2)
    metadata = peer.receive().metadata
    assert (metadata["scene"], metadata["registration"]) == ("second", "plain")
    set_to(peer, Registration="", Scene="demo")
    peer.send_pose(moved(2), "ProbeToTracker", version=2)
    answer = peer.receive()
    assert "registration" not in answer.metadata
    np.testing.assert_allclose(unpack_image(answer.content).matrix[0, 3], 2.0 - 20.0 + 20.0 / 48, atol=1e-3)


def test_a_registration_that_is_not_there_or_of_another_scene_is_told(peer: Peer, service: RunningService) -> None:
    reply = ask(peer, command("SetUsParameter", ("Registration", "nobody")))
    assert "there is no registration 'nobody'" in str(reply.get("Error"))
    peer.send_pose(MARKER_TO_TRACKER, "ProbeTosecond")
    assert "registration must be one of the scene 'second'" in peer.status().text
    with Client(service.grpc, timeout_s=60.0) as client:
        client.registrations.put("brief", "demo", np.eye(4))
        set_to(peer, Registration="brief")
        client.registrations.delete("brief")
    peer.send_pose(MARKER_TO_TRACKER, "ProbeToTracker")
    assert peer.status().code == NOT_FOUND
