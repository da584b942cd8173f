"""What is asked again, for how long, and what is not."""

from __future__ import annotations

import socket
from typing import Any

import pytest

from ultragray_client import connection, errors
from ultragray_client.connection import Retries


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
