"""Requests, frames and streams over the limits of a key, at the doors of a real service."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import grpc
import httpx
import numpy as np
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from ultragray_client import Client, RenderSettings
from ultragray_proto.v1 import access_pb2, access_pb2_grpc, rendering_pb2

from ....waiting import wait_until
from ...conftest import RunningService, StartService
from ...igtl.conftest import Peer, address_of
from ...rpc.test_grpc_render import moved
from ..conftest import POSE
from .conftest import SMALL, Limited, render_request, render_settings, retry_after_s

BUSY = 6  # of OpenIGTLink


def refused(ask: Callable[[], httpx.Response]) -> httpx.Response:
    """The first answer that is a refusal: a busy machine may be too slow to exceed a limit with the second."""

    def answer() -> httpx.Response | None:
        response = ask()
        return None if response.status_code == 200 else response

    return wait_until(answer, every_s=0.0)


def refused_call(ask: Callable[[], object]) -> grpc.RpcError:
    def error() -> grpc.RpcError | None:
        try:
            ask()
        except grpc.RpcError as error:
            return error
        return None

    return wait_until(error, every_s=0.0)


@contextmanager
def stream(limited: Limited, who: str) -> Iterator[ClientConnection]:
    url = f"{limited.service.http.replace('http', 'ws', 1)}/v1/scenes/demo/stream"
    with connect(url, additional_headers={"x-api-key": limited.keys[who]}, max_size=None) as connection:
        yield connection


def send(connection: ClientConnection, sequence: int, **more: Any) -> None:
    connection.send(json.dumps({"sequence": sequence, "pose": POSE, **more}))


def receive(connection: ClientConnection) -> dict[str, Any]:
    message = connection.recv(timeout=120)
    if isinstance(message, str):
        return dict(json.loads(message))
    return dict(json.loads(message[4 : 4 + int.from_bytes(message[:4], "little")]))


def test_requests_beyond_the_rate_are_refused_and_pass_after_the_time_that_is_told(limited: Limited) -> None:
    answer = refused(lambda: limited.http("requests", "GET", "/v1/scenes"))
    assert (answer.status_code, answer.json()["reason"]) == (429, "RATE_LIMITED")
    assert "1 requests a second (requests_per_s)" in answer.json()["detail"]
    assert limited.refusals("requests_per_s") >= 1
    assert limited.client.get("/v1/health/ready").status_code == 200  # which nobody counts
    time.sleep(int(answer.headers["Retry-After"]))
    assert limited.http("requests", "GET", "/v1/scenes").status_code == 200


def test_calls_of_grpc_count_as_requests(limited: Limited) -> None:
    stub = access_pb2_grpc.AccessServiceStub(limited.channel)

    def ask() -> object:
        return stub.WhoAmI(access_pb2.WhoAmIRequest(), metadata=limited.metadata("calls"), timeout=60)

    delay_s = retry_after_s(refused_call(ask), "RATE_LIMITED")
    assert delay_s is not None
    assert 0.0 < delay_s < 1.1
    time.sleep(delay_s)
    ask()


def test_frames_beyond_the_rate_are_refused_and_pass_after_the_time_that_is_told(limited: Limited) -> None:
    answer = refused(lambda: limited.render("frames"))
    assert (answer.status_code, answer.json()["reason"]) == (429, "RATE_LIMITED")
    time.sleep(int(answer.headers["Retry-After"]))
    assert limited.render("frames").status_code == 200

    def ask() -> object:
        return limited.renders().Render(render_request(), metadata=limited.metadata("rpc-frames"), timeout=60)

    delay_s = retry_after_s(refused_call(ask), "RATE_LIMITED")
    assert delay_s is not None
    time.sleep(delay_s)
    ask()


def test_every_frame_of_a_batch_counts_and_the_batch_takes_the_seconds_that_it_needs(limited: Limited) -> None:
    began = time.monotonic()
    assert limited.render("poses", poses=[POSE] * 10).status_code == 200
    assert time.monotonic() - began >= 2.0
    hopeless = limited.render("poses", poses=[POSE] * 10, timeout_ms=500)
    assert (hopeless.status_code, hopeless.json()["reason"]) == (422, "TOO_MANY_POSES")
    began = time.monotonic()
    request = rendering_pb2.RenderBatchRequest(settings=render_settings(), poses=[moved(0)] * 10)
    frames = limited.renders().RenderBatch(request, metadata=limited.metadata("batch"), timeout=120)
    assert [frame.sequence for frame in frames] == list(range(10))
    assert time.monotonic() - began >= 2.0


def test_an_ordered_stream_waits_for_each_frame(limited: Limited) -> None:
    with stream(limited, "ordered") as connection:
        connection.send(json.dumps({"settings": SMALL}))
        began = time.monotonic()
        for sequence in range(10):
            send(connection, sequence)
        answers = [receive(connection) for _ in range(10)]
    assert time.monotonic() - began >= 2.0
    assert [answer["sequence"] for answer in answers] == list(range(10))
    assert not any("error" in answer for answer in answers)


def test_a_latest_stream_renders_the_newest_pose_whenever_it_may(limited: Limited) -> None:
    with stream(limited, "latest") as connection:
        connection.send(json.dumps({"settings": SMALL, "mode": "latest"}))
        send(connection, 0)
        send(connection, 1)
        answers = [receive(connection)]
        for sequence in range(2, 31):
            send(connection, sequence)
        while answers[-1]["sequence"] != 30:
            answers.append(receive(connection))
    assert not any("error" in answer for answer in answers)
    assert len(answers) < 10
    assert len(answers) + sum(answer["dropped"] for answer in answers) == 31


def test_streams_at_once_are_limited_over_all_doors(limited: Limited) -> None:
    def open_one() -> None:
        with stream(limited, "streams"):
            pass

    def call() -> list[rendering_pb2.Frame]:
        request = rendering_pb2.RenderStreamRequest(settings=render_settings(), pose=moved(0))
        metadata = limited.metadata("streams")
        return list(limited.renders().RenderStream(iter([request]), metadata=metadata, timeout=60))

    with stream(limited, "streams"):
        with pytest.raises(InvalidStatus) as caught:
            open_one()
        document = json.loads(caught.value.response.body or b"")
        assert (document["reason"], document["status"]) == ("LIMIT_REACHED", 429)
        assert "Retry-After" not in caught.value.response.headers  # nobody knows when the other one ends
        with pytest.raises(grpc.RpcError) as refused:
            call()
        assert retry_after_s(refused.value, "LIMIT_REACHED") is None
        with stream(limited, "unlimited"), stream(limited, "unlimited"):
            pass  # the limit of all keys is not that of a key that has its own
    wait_until(lambda: _works(open_one))
    wait_until(lambda: _works(call))
    assert limited.refusals("streams") >= 2


def _works(open_stream: Callable[[], object]) -> bool:
    """Whether a stream opens: that of before ends on its own time."""
    try:
        open_stream()
    except (InvalidStatus, grpc.RpcError):
        return False
    return True


def test_the_python_client_waits_as_long_as_it_is_told(limited: Limited) -> None:
    with Client(limited.service.grpc, api_key=limited.keys["client"], timeout_s=120.0) as client:
        began = time.monotonic()
        for _ in range(5):
            client.render("demo", np.eye(4), RenderSettings(**SMALL))
        assert time.monotonic() - began >= 2.0
    assert limited.refusals("frames_per_s") >= 1


def test_a_greedy_client_costs_a_polite_one_nothing(limited: Limited) -> None:
    stop = threading.Event()
    statuses: list[int] = []

    def hammer() -> None:
        while not stop.is_set():
            statuses.append(limited.render("greedy").status_code)

    threads = [threading.Thread(target=hammer) for _ in range(4)]
    for thread in threads:
        thread.start()
    try:
        wait_until(lambda: 429 in statuses)
        assert {limited.render("polite").status_code for _ in range(20)} == {200}
    finally:
        stop.set()
        for thread in threads:
            thread.join(60)
    assert set(statuses) == {200, 429}


@pytest.fixture(scope="module")
def by_address(start_service: StartService) -> RunningService:
    """Without keys: each address has limits of its own."""
    return start_service(igtl_port=0, igtl_scene="demo", key_streams=1, key_frames_per_s=2)


def test_without_keys_every_address_has_the_limits_of_a_key(by_address: RunningService) -> None:
    body = {"pose": POSE, **SMALL}

    def client(source: str) -> httpx.Client:
        return httpx.Client(base_url=by_address.http, transport=httpx.HTTPTransport(local_address=source), timeout=60)

    with client("127.0.0.4") as greedy, client("127.0.0.5") as polite:
        assert refused(lambda: greedy.post("/v1/scenes/demo/render", json=body)).status_code == 429
        assert polite.post("/v1/scenes/demo/render", json=body).status_code == 200


def test_openigtlink_is_limited_by_address(by_address: RunningService) -> None:
    address = address_of(by_address)
    peer = Peer(address, source="127.0.0.2")
    second = Peer(address, source="127.0.0.2")
    status = second.status()
    assert (status.code, status.sub_code, status.name) == (BUSY, 429, "LIMIT_REACHED")
    assert second.is_closed()
    second.socket.close()
    Peer(address, source="127.0.0.3").socket.close()
    began = time.monotonic()
    for _ in range(5):  # an image comes before the next pose is sent
        peer.send_pose(np.eye(4))
        peer.image()
    assert time.monotonic() - began >= 2.0
    peer.socket.close()
