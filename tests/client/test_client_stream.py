"""Streams of poses."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from typing import Any

import numpy as np
import pytest

from ultragray_client import RenderSettings, errors
from ultragray_client.exchange import PoseExchange
from ultragray_client.frames import settings_message
from ultragray_proto.v1 import geometry_pb2, rendering_pb2, scenes_pb2

from ..freshness import check_fresh
from ..service.conftest import StartService
from ..waiting import wait_until
from .test_client_render import moved


def test_an_ordered_stream_answers_every_pose(client: Any) -> None:
    shifts = np.linspace(-4, 4, 120)
    with client.stream("demo", RenderSettings(height=16, width=16)) as stream:
        sequences = [stream.send(moved(x)) for x in shifts[:60]]
        frames = [stream.receive() for _ in range(60)]
        sequences += [stream.send(moved(x)) for x in shifts[60:]]
        stream.done_sending()
        frames += list(stream)
        with pytest.raises(errors.StreamEnded):
            stream.receive()
        with pytest.raises(errors.StreamEnded):
            stream.send(moved(0.0))
    assert sequences == list(range(1, 121)) == [frame.sequence for frame in frames]
    assert [frame.pose[0, 3] for frame in frames] == shifts.tolist()
    assert {frame.dropped for frame in frames} == {0}
    assert all(0.0 < frame.timings.render_ms < frame.latency_ms < 60_000 for frame in frames)


def test_a_latest_stream_counts_what_it_drops(client: Any) -> None:
    with client.stream(
        "demo", RenderSettings(height=600, width=600, outputs=("bmode", "echo")), mode="latest"
    ) as stream:
        for x in np.linspace(-4, 4, 200):
            stream.send(moved(x))
        stream.done_sending()
        frames = list(stream)
    assert len(frames) < 150
    assert len(frames) + sum(frame.dropped for frame in frames) == 200
    assert frames[-1].sequence == 200
    assert frames[-1].pose[0, 3] == 4.0


def test_latency_counts_from_the_measurement(client: Any) -> None:
    with client.stream("demo", RenderSettings(height=8, width=8)) as stream:
        stream.send(moved(0.0), measured_ns=time.monotonic_ns() - 5_000_000_000)
        assert stream.receive().latency_ms > 5000.0


def test_a_pose_that_gets_no_frame_does_not_end_a_stream(client: Any) -> None:
    with client.stream("demo", RenderSettings(height=8, width=8)) as stream:
        stream.send(moved(0.0))
        bad = stream.send(2 * np.eye(4))
        late = stream.send(moved(0.0), timeout_s=1e-9)
        stream.send(moved(1.0))
        assert stream.receive().sequence == 1
        with pytest.raises(errors.InvalidPose) as refused:
            stream.receive()
        with pytest.raises(errors.DeadlineExceeded) as passed:
            stream.receive()
        assert (refused.value.sequence, passed.value.sequence) == (bad, late)
        assert stream.receive().pose[0, 3] == 1.0


def test_refused_settings_are_told_first(client: Any) -> None:
    with client.stream("gone") as stream:
        stream.send(moved(0.0))
        with pytest.raises(errors.SceneNotFound):
            stream.receive()
    with pytest.raises(errors.InvalidArgument, match="newest"):
        client.stream("demo", mode="newest")


def send_until_it_ends(stream: Any) -> None:
    """Or 50 poses long: an ordered stream that nobody reads takes no more than 64."""
    with suppress(errors.StreamEnded, errors.Unavailable):
        for _ in range(50):
            stream.send(moved(0.0))


def test_a_stream_may_be_used_by_two_threads(client: Any) -> None:
    with client.stream("demo", RenderSettings(height=8, width=8)) as stream:

        def send() -> None:
            for _ in range(300):
                stream.send(moved(0.0))
            stream.done_sending()

        sender = threading.Thread(target=send)
        sender.start()
        assert [frame.sequence for frame in stream] == list(range(1, 301))
        sender.join()


def test_a_service_that_stops_ends_a_stream_that_is_not_to_reconnect(
    make_client: Any, start_service: StartService
) -> None:
    service = start_service()
    client = make_client(service.grpc)
    with client.stream("demo", RenderSettings(height=8, width=8), reconnect_s=0.0) as stream:
        stream.send(moved(0.0))
        stream.receive()
        service.terminate()
        with pytest.raises(errors.Unavailable):
            stream.receive()
        with pytest.raises(errors.ClientError):
            stream.send(moved(0.0))


def test_the_frames_before_the_end_of_a_stream_come(make_client: Any, start_service: StartService) -> None:
    service = start_service()
    stream = make_client(service.grpc).stream("demo", RenderSettings(height=8, width=8), reconnect_s=0.0)
    for _ in range(5):
        stream.send(moved(0.0))
    wait_until(lambda: service.metric("ultragray_frames_total") >= 5)
    service.terminate()
    send_until_it_ends(stream)
    sequences: list[int] = []
    with pytest.raises(errors.Unavailable):
        sequences.extend(frame.sequence for frame in stream)
    assert sequences == list(range(1, len(sequences) + 1))
    assert len(sequences) >= 5


def test_what_was_dropped_before_an_error_is_told_with_the_next_frame() -> None:
    exchange = PoseExchange(settings_message("demo", None), "latest")
    error = scenes_pb2.Error(reason="DEADLINE_EXCEEDED", detail="late")
    with pytest.raises(errors.DeadlineExceeded):
        exchange.frame(exchange.arrived(rendering_pb2.Frame(sequence=3, error=error, dropped=2)))
    answer = rendering_pb2.Frame(
        sequence=5,
        outputs=[rendering_pb2.OUTPUT_BMODE],
        encoding=rendering_pb2.ENCODING_UINT8,
        height=1,
        width=2,
        data=b"ab",
        pose=geometry_pb2.Matrix(values=np.eye(4).ravel()),
        probe=geometry_pb2.Probe(linear=geometry_pb2.LinearProbe(width_mm=1, far_mm=1)),
        timings=rendering_pb2.Timings(),
        extrapolation=rendering_pb2.Extrapolation(),
        picture=rendering_pb2.Picture(),
        dropped=1,
    )
    assert exchange.frame(exchange.arrived(answer), dropped_here=4).dropped == 7
    assert exchange.frame(exchange.arrived(answer)).dropped == 1


class ClientDoor:
    """A latest stream of either client."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def send(self) -> None:
        self._stream.send(moved(0.0))

    def receive(self) -> float:
        frame = self._stream.receive()
        return time.monotonic() - float(frame.latency_ms) / 1000


@pytest.mark.parametrize("make_client", ["sync"], indirect=True)
def test_a_latest_stream_gives_no_old_frame(client: Any) -> None:
    with client.stream("demo", RenderSettings(height=128, width=128), mode="latest") as stream:
        check_fresh(ClientDoor(stream))


def test_a_latest_stream_may_be_read_before_anything_is_sent(client: Any) -> None:
    with client.stream("demo", RenderSettings(height=8, width=8), mode="latest") as stream:
        frames: list[Any] = []
        reader = threading.Thread(target=lambda: frames.append(stream.receive()))
        reader.start()
        stream.send(moved(0.0))
        reader.join()
        assert frames[0].sequence == 1
