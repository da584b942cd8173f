"""What is asked again, for how long, and what is not."""

from __future__ import annotations

import socket
import threading
from typing import Any

import numpy as np
import pytest

from ultragray_client import RenderSettings, connection, errors
from ultragray_client.connection import Retries

from ..service.conftest import RunningService, StartService
from .test_client_render import moved


def test_pauses_grow_after_the_delay_that_the_service_told() -> None:
    retries = Retries(1000.0, patience_s=None)
    full = errors.QueueFull("full", retry_after_s=2.0)
    pauses_s = [retries.pause_s(full) for _ in range(10)]
    for failures, pause_s in enumerate(pauses_s):
        backoff_s = min(0.1 * 2**failures, 5.0)
        assert 2.0 + 0.5 * backoff_s <= pause_s <= 2.0 + backoff_s
    retries.progress()
    assert retries.pause_s(full) <= 2.1
    assert len({Retries(1000.0, None).pause_s(full) for _ in range(5)}) > 1


@pytest.mark.parametrize(
    "error",
    [
        errors.InvalidPose("no"),
        errors.SceneNotFound("no"),
        errors.StorageFull("no"),
        errors.DeadlineExceeded("no"),
        errors.RenderFailed("no"),
        errors.Unauthenticated("no"),
    ],
)
def test_what_cannot_succeed_is_not_asked_again(error: errors.ClientError) -> None:
    with pytest.raises(type(error)):
        Retries(1000.0, 1000.0).pause_s(error)


def test_no_pause_reaches_beyond_the_deadline() -> None:
    retries = Retries(5.0, patience_s=1000.0)
    assert retries.pause_s(errors.QueueFull("full", retry_after_s=1.0)) < 5.0
    with pytest.raises(errors.JobQueueFull):
        retries.pause_s(errors.JobQueueFull("full", retry_after_s=10.0))
    remaining_s = retries.remaining_s()
    assert remaining_s is not None
    assert 4.0 < remaining_s <= 5.0


def test_without_a_deadline_patience_counts_from_the_first_failure_since_anything_came(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = 1000.0
    monkeypatch.setattr(connection.time, "monotonic", lambda: now)
    retries = Retries(None, patience_s=3.0)
    assert retries.remaining_s() is None
    gone = errors.Unreachable("gone")
    now += 4.0  # a quiet call is no failure
    assert retries.pause_s(gone) < 3.0
    now += 2.9
    with pytest.raises(errors.Unreachable):
        retries.pause_s(gone)
    retries.progress()
    assert retries.pause_s(gone) < 3.0


def test_the_shorter_of_deadline_and_patience_counts() -> None:
    gone = errors.Unreachable("gone", retry_after_s=2.0)
    for retries in (Retries(1.0, patience_s=60.0), Retries(60.0, patience_s=1.0)):
        with pytest.raises(errors.Unreachable):
            retries.pause_s(gone)
    with pytest.raises(errors.Unreachable):
        Retries(60.0, patience_s=0.0).pause_s(errors.Unreachable("gone"))


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port: int = listener.getsockname()[1]
        return port


def test_nobody_there_is_told_in_time(make_client: Any) -> None:
    client = make_client(f"127.0.0.1:{free_port()}")
    with pytest.raises(errors.Unreachable, match="no service answers at 127"):
        client.scenes.list(timeout_s=1.0)


@pytest.mark.long
def test_a_service_that_comes_late_is_found(make_client: Any, start_service: StartService) -> None:
    port = free_port()
    client = make_client(f"127.0.0.1:{port}", timeout_s=60.0)
    service: list[RunningService] = []
    starting = threading.Thread(target=lambda: service.append(start_service(grpc_port=port)))
    starting.start()
    assert client.render("demo", moved(0.0), RenderSettings(height=8, width=8))["bmode"].shape == (8, 8)
    starting.join()
    service[0].terminate()


@pytest.mark.long
def test_a_batch_goes_on_where_a_service_is_restarted(make_client: Any, start_service: StartService) -> None:
    first = start_service()
    port = int(first.grpc.rpartition(":")[2])
    client = make_client(first.grpc, timeout_s=60.0)
    shifts = np.linspace(-4, 4, 1500)
    second: list[RunningService] = []

    def restart() -> None:
        first.terminate()
        second.append(start_service(grpc_port=port))

    restarting = threading.Thread(target=restart)
    frames = []
    for frame in client.render_batch("demo", map(moved, shifts), RenderSettings(height=150, width=150)):
        frames.append(frame)
        if len(frames) == 10:
            restarting.start()
    restarting.join()
    second[0].terminate()
    assert [frame.sequence for frame in frames] == list(range(1500))
    assert [frame.pose[0, 3] for frame in frames] == shifts.tolist()
    records = [record for record in second[0].log() if record.get("method", "").endswith("RenderBatch")]
    assert records, "the first service must not have rendered them all"


@pytest.mark.long
def test_a_full_queue_is_asked_again(make_client: Any, start_service: StartService) -> None:
    service = start_service(queue_limit_frames=1)
    client = make_client(service.grpc, timeout_s=60.0)
    results: list[Any] = []

    def render() -> None:
        results.append(
            client.render("demo", moved(0.0), RenderSettings(height=600, width=600, outputs=("bmode", "echo")))
        )

    threads = [threading.Thread(target=render) for _ in range(5)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(results) == 5
    refused = [record for record in service.log() if record.get("status") == "RESOURCE_EXHAUSTED"]
    assert refused, "the queue was never full"
    service.terminate()
