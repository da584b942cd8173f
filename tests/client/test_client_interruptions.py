"""Connections that break off half-way."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ultragray_client import JobState, RenderJob, RenderSettings, errors
from ultragray_client.calls import Deletion, Pause
from ultragray_client.connection import Retries, Terms
from ultragray_client.conversations import Watch, download_into
from ultragray_proto.v1 import jobs_pb2

from ..service.conftest import RunningService
from .proxy import Proxy


@pytest.fixture(scope="module")
def client_service(working_service: RunningService) -> RunningService:
    """One with a worker."""
    return working_service


def test_a_batch_goes_on(far_client: Any, proxy: Proxy) -> None:
    poses = np.tile(np.eye(4), (120, 1, 1))
    poses[:, 0, 3] = np.linspace(-4, 4, 120)
    batch = far_client.render_batch("demo", poses, RenderSettings(height=64, width=64))
    frames = [next(batch)]
    proxy.cut_after(150_000)
    frames += list(batch)
    assert proxy.cuts == 1
    assert [frame.sequence for frame in frames] == list(range(120))
    assert [frame.pose[0, 3] for frame in frames] == poses[:, 0, 3].tolist()


def test_a_download_goes_on_and_is_whole(far_client: Any, client: Any, proxy: Proxy, tmp_path: Path) -> None:
    poses = np.tile(np.eye(4), (60, 1, 1))
    job = client.jobs.submit(
        RenderJob(scene="demo", poses=poses, height=200, width=200, dtype="float32", outputs=("bmode", "echo"))
    )
    assert client.jobs.wait(job.id, timeout_s=120).state is JobState.SUCCEEDED
    client.jobs.download(job.id, "frames.npz", tmp_path / "straight.npz")
    proxy.cut_after(8_000_000)
    far_client.jobs.download(job.id, "frames.npz", tmp_path / "broken.npz")
    assert proxy.cuts == 1
    assert (tmp_path / "broken.npz").read_bytes() == (tmp_path / "straight.npz").read_bytes()
    assert {path.name for path in tmp_path.iterdir()} == {"straight.npz", "broken.npz"}


def test_a_watch_goes_on(far_client: Any, client: Any, proxy: Proxy) -> None:
    job = client.jobs.submit(RenderJob(scene="demo", poses=np.tile(np.eye(4), (20_000, 1, 1)), height=300, width=300))
    events = far_client.jobs.watch(job.id)
    assert next(events).job.id == job.id
    proxy.cut_after(0)
    cancel = threading.Timer(0.5, client.jobs.cancel, (job.id,))
    cancel.start()
    assert [event.job.state for event in events if event.job][-1] is JobState.CANCELLED
    cancel.join()  # its answer may come after the event
    assert proxy.cuts == 1


def test_a_file_that_does_not_come_leaves_nothing(tmp_path: Path) -> None:
    def half() -> None:
        with download_into("job", "file", tmp_path / "file") as download:
            download.keep(jobs_pb2.ArtifactChunk(data=b"half", file_bytes=8))
            request = download.request()
            assert request is not None
            assert request.offset == 4
            download.end_of_call()

    with pytest.raises(errors.Unreachable, match="after 4 bytes"):
        half()
    assert not list(tmp_path.iterdir())


def test_an_empty_file_is_a_file(tmp_path: Path) -> None:
    with download_into("job", "file", tmp_path / "file") as download:
        download.keep(jobs_pb2.ArtifactChunk(data=b"", file_bytes=0))
        download.end_of_call()
        assert download.request() is None
    assert (tmp_path / "file").read_bytes() == b""


def test_a_log_is_not_told_twice() -> None:
    watch, retries = Watch("job"), Retries(None, patience_s=60.0)

    def new(log: str) -> str:
        return watch.take(jobs_pb2.JobEvent(log=log)).log

    def break_off() -> None:
        watch.pause_s(errors.Unreachable("gone"), retries)

    assert new("one\ntwo\n") == "one\ntwo\n"
    assert new("two\n") == "two\n"
    break_off()
    assert new("") == ""
    assert new("one\ntwo\ntwo\nthree\n") == "three\n"
    assert new("three\n") == "three\n"
    break_off()
    assert new("elsewhere\n") == "elsewhere\n"


@pytest.mark.parametrize(
    ("failures", "is_refused"),
    [
        ([errors.Unreachable, errors.NotFound], False),
        ([errors.NotFound], True),
        ([errors.Unreachable, errors.JobInUse], True),
        ([errors.Unreachable], False),
    ],
)
def test_a_deletion_that_had_worked_is_no_error(failures: list[type[errors.ClientError]], is_refused: bool) -> None:
    steps = Deletion("JobService.DeleteJob", None, None).steps(Terms("127.0.0.1:1", None, None, 60.0))
    left = list(failures)

    def run() -> None:
        step = next(steps)
        with suppress(StopIteration):
            while True:
                is_through = isinstance(step, Pause) or not left
                step = steps.send(None) if is_through else steps.throw(left.pop(0)("no"))

    with pytest.raises(errors.ClientError) if is_refused else nullcontext():
        run()
    assert not left


def test_a_silent_peer_does_not_hold_a_call(make_client: Callable[..., Any]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        client = make_client(f"127.0.0.1:{silent.getsockname()[1]}")
        with pytest.raises((errors.DeadlineExceeded, errors.Unreachable)):
            client.scenes.list(timeout_s=0.5)
