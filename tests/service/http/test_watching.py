"""Watching the streams of others: the list, and the WebSocket that shows one."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from typing import Any

import httpx
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from ultragray_client import Client
from ultragray_proto.v1 import geometry_pb2, rendering_pb2, rendering_pb2_grpc

from ...waiting import wait_until
from ..conftest import RunningService
from .test_websocket import address, at

TIMEOUT_S = 120.0
POSES = 40


def streams(http: httpx.Client, **query: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = http.get("/v1/streams", params=query).raise_for_status().json()["streams"]
    return found


def watching(service: RunningService, stream_id: str, **options: Any) -> ClientConnection:
    base = service.http.replace("http", "ws", 1)
    return connect(f"{base}/v1/streams/{stream_id}/watch", max_size=None, close_timeout=0.2, **options)


def shown(watcher: ClientConnection) -> tuple[dict[str, Any], bytes]:
    message = watcher.recv(timeout=TIMEOUT_S)
    if isinstance(message, str):
        return json.loads(message), b""
    (length,) = struct.unpack_from("<I", message)
    return json.loads(message[4 : 4 + length]), message[4 + length :]


@pytest.fixture
def robot(service: RunningService) -> Iterator[ClientConnection]:
    with connect(f"{address(service)}?name=UR5", compression=None, max_size=None, close_timeout=0.2) as connection:
        yield connection


def named(http: httpx.Client, name: str) -> dict[str, Any]:
    """The newest stream of a name: that of the test before may still be closing."""
    return wait_until(lambda: next((one for one in reversed(streams(http)) if one["name"] == name), None))


def step(robot: ClientConnection, sequence: int, x: float, **others: Any) -> tuple[dict[str, Any], bytes]:
    robot.send(json.dumps({"sequence": sequence, "mode": "latest", "pose": at(x), **others}))
    return shown(robot)


def test_a_watcher_sees_each_frame_as_the_client_gets_it(
    service: RunningService, http: httpx.Client, robot: ClientConnection
) -> None:
    step(robot, 0, 0.0, settings={"height": 40, "width": 30, "outputs": ["bmode", "coverage"]})
    told = named(http, "UR5")
    assert (told["door"], told["scene"], told["frames"]) == ("websocket", "demo", 1)
    with watching(service, told["id"]) as watcher:
        wait_until(lambda: named(http, "UR5")["watchers"] == 1)
        for sequence in range(1, POSES + 1):
            own, pixels = step(robot, sequence, sequence / 10)
            seen, passed_on = shown(watcher)
            assert seen == own
            assert passed_on == pixels
    assert streams(http, scene="demo")
    assert streams(http, scene="another") == []


def test_a_watcher_that_does_not_read_holds_up_no_stream(
    service: RunningService, http: httpx.Client, robot: ClientConnection
) -> None:
    step(robot, 0, 0.0, settings={"height": 512, "width": 512, "encoding": "float32"})
    told = named(http, "UR5")

    with watching(service, told["id"], max_queue=1):
        wait_until(lambda: named(http, "UR5")["watchers"] == 1)
        for sequence in range(1, 2 * POSES + 1):  # 84 MB that nobody reads
            step(robot, sequence, sequence / 10)
    assert step(robot, 2 * POSES + 1, 0.0)[0]["sequence"] == 2 * POSES + 1


def test_a_watcher_is_told_of_refusals_and_of_the_end(
    service: RunningService, http: httpx.Client, robot: ClientConnection
) -> None:
    step(robot, 0, 0.0)
    told = named(http, "UR5")
    with watching(service, told["id"]) as watcher:
        wait_until(lambda: named(http, "UR5")["watchers"] == 1)
        robot.send(json.dumps({"sequence": 7, "pose": {"matrix": [[1]]}}))
        assert shown(robot)[0]["error"]["reason"] == "INVALID_POSE"
        about, _ = shown(watcher)
        assert (about["sequence"], about["error"]["reason"]) == (7, "INVALID_POSE")
        robot.close()
        with pytest.raises(ConnectionClosed) as closed:
            shown(watcher)
        assert closed.value.rcvd is not None
        assert (closed.value.rcvd.code, closed.value.rcvd.reason) == (1000, "STREAM_ENDED")
    with pytest.raises(InvalidStatus) as refused:
        watching(service, told["id"])
    assert json.loads(refused.value.response.body)["reason"] == "STREAM_NOT_FOUND"


def test_a_call_of_grpc_is_watched_too(service: RunningService, http: httpx.Client) -> None:
    with service.channel() as channel:
        calls = rendering_pb2_grpc.RenderServiceStub(channel)
        identity = geometry_pb2.Pose(matrix=geometry_pb2.Matrix(values=np.eye(4).ravel()))
        settings = rendering_pb2.RenderSettings(scene="demo", height=20, width=30)

        def requests() -> Iterator[rendering_pb2.RenderStreamRequest]:
            yield rendering_pb2.RenderStreamRequest(sequence=1, settings=settings, pose=identity)
            wait_until(lambda: named(http, "arm")["frames"] == 1)
            with watching(service, named(http, "arm")["id"]) as watcher:
                wait_until(lambda: named(http, "arm")["watchers"] == 1)
                yield rendering_pb2.RenderStreamRequest(sequence=2, pose=identity)
                seen.append(shown(watcher))

        seen: list[tuple[dict[str, Any], bytes]] = []
        metadata = (("x-ultragray-stream-name", "arm"),)
        frames = list(calls.RenderStream(requests(), metadata=metadata, timeout=TIMEOUT_S))
    assert [frame.sequence for frame in frames] == [1, 2]
    assert seen[0][0]["sequence"] == 2
    assert seen[0][1] == frames[1].data


def test_the_service_tells_its_ports(service: RunningService, http: httpx.Client) -> None:
    told = http.get("/v1/service").raise_for_status().json()
    assert told["grpc_port"] == int(service.grpc.rpartition(":")[2])
    assert (told["igtl_port"], told["tls"], told["key_required"]) == (None, False, False)


def test_poses_are_assessed_as_frames_are_without_their_support(service: RunningService, http: httpx.Client) -> None:
    poses = [at(0.0), at(2.5), {"matrix": np.eye(4).tolist()}]
    found = http.post("/v1/scenes/demo:assess", json={"poses": poses}).raise_for_status().json()["extrapolations"]
    with Client(service.grpc) as client:
        matrices = np.tile(np.eye(4), (3, 1, 1))
        matrices[1, 0, 3] = 2.5
        told = client.assess_poses("demo", matrices)
        frame = client.render("demo", matrices[1])
    assert [one["distance_mm"] for one in found] == [one.distance_mm for one in told]
    assert found[1]["distance_mm"] == pytest.approx(frame.extrapolation.distance_mm)
    assert found[1]["supported_share"] is told[1].supported_share is None


@pytest.mark.parametrize(
    ("body", "reason", "field"),
    [
        ({}, "INVALID_ARGUMENT", "poses"),
        ({"poses": [{"matrix": [[1]]}]}, "INVALID_POSE", "poses[0].matrix"),
        ({"poses": [at(0.0)] * 1025}, "TOO_MANY_POSES", "poses"),
        ({"poses": [at(0.0)], "probe": {"kind": "linear"}}, "INVALID_PROBE", "probe"),
    ],
)
def test_what_cannot_be_assessed_is_refused(http: httpx.Client, body: Any, reason: str, field: str) -> None:
    answer = http.post("/v1/scenes/demo:assess", json=body)
    assert (answer.status_code, answer.json()["reason"]) == (422, reason)
    assert answer.json()["field"].startswith(field)
