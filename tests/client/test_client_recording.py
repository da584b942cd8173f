"""Recordings of received frames, read with MCAP's own reader and beside the files of jobs."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from ultragray_client import (
    ConvexProbe,
    Display,
    Needle,
    Recording,
    RenderJob,
    RenderSettings,
    ToolFrame,
    errors,
)

from ..file_sizes import files_of_at_most
from ..service.conftest import RunningService
from .conftest import KEY
from .test_client_render import moved

COUNT = 30
POSES = np.stack([moved(x) for x in np.linspace(-4.0, 4.0, COUNT)])


@pytest.fixture(scope="module")
def client_service(working_service: RunningService) -> RunningService:
    """One with a worker."""
    return working_service


def decoded(path: Path, topic: str) -> list[Any]:
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [found.decoded_message for found in reader.iter_decoded_messages(topics=[topic])]


@pytest.mark.slow
@pytest.mark.parametrize("make_client", ["sync"], indirect=True)
def test_a_recording_is_the_file_of_the_job_that_renders_the_same(client: Any, tmp_path: Path) -> None:
    settings: dict[str, Any] = {
        "height": 24,
        "width": 20,
        "outputs": ("bmode", "transmittance"),
        "probe": ConvexProbe(60.0, 40.0, 90.0),
        "display": Display(gain_db=3.0, depth_mm=30.0, flip=True),
        "tools": (Needle(tip_mm=(0.0, 0.0, 20.0), hub_mm=(10.0, 0.0, 5.0), frame=ToolFrame.PROBE),),
        "ghost": 0.2,
    }
    job = client.jobs.submit(RenderJob(scene="demo", poses=POSES, format="mcap", **settings))
    client.jobs.wait(job.id, timeout_s=120.0)
    client.jobs.download(job.id, "frames.mcap", tmp_path / "job.mcap")
    with Recording(tmp_path / "recorded.mcap") as recording:
        for frame in client.render_batch("demo", POSES, RenderSettings(**settings)):
            recording.add(frame)
    assert (tmp_path / "recorded.mcap").read_bytes() == (tmp_path / "job.mcap").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["job.mcap", "recorded.mcap"]


def test_a_stream_is_recorded_with_its_own_times_and_changes_of_geometry(client: Any, tmp_path: Path) -> None:
    path = tmp_path / "stream.mcap"
    now_ns = 1_900_000_000_123_456_789
    with Recording(path) as recording:
        for part, width in ((POSES[:4], 16), (POSES[4:6], 12)):
            with client.stream("demo", RenderSettings(height=16, width=width)) as stream:
                for number, pose in enumerate(part):
                    stream.send(pose)
                    recording.add(stream.receive(), time_ns=now_ns + number)
    stamps = [(one.header.stamp.sec, one.header.stamp.nanosec) for one in decoded(path, "/ultragray/bmode")]
    assert stamps == [(1_900_000_000, 123_456_789 + number) for number in (0, 0, 1, 1, 2, 3)]
    told = [json.loads(one.data) for one in decoded(path, "/ultragray/geometry")]
    assert [one["width"] for one in told] == [16, 12]
    assert told[0]["probe"]["kind"] == "linear"
    place = np.array(told[0]["pixel_to_probe_m"]) @ [0.0, 0.0, 0.0, 1.0]
    frame = client.render("demo", POSES[0], RenderSettings(height=16, width=16))
    np.testing.assert_allclose(1000.0 * place[:3], (frame.picture.pixel_to_probe() @ [0, 0, 0, 1])[:3])


def test_what_came_before_an_error_is_kept(client: Any, tmp_path: Path) -> None:
    path = tmp_path / "kept.mcap"
    path.write_bytes(b"an older file")
    frame = client.render("demo", POSES[0], RenderSettings(height=8, width=8))
    recording = Recording(path)

    def interrupted() -> None:
        with recording:
            recording.add(frame)
            assert path.read_bytes() == b"an older file"
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert len(decoded(path, "/ultragray/bmode")) == 1
    with pytest.raises(errors.InvalidArgument, match="is closed"):
        recording.add(frame)
    recording.close()


INTERRUPTED = """
import signal, sys
import numpy as np
from ultragray_client import Client, Recording
signal.signal(signal.SIGINT, signal.default_int_handler)  # tests in the background of a shell are begun with it ignored
address, key, path = sys.argv[1:]
with Client(address, api_key=key) as client:
    frame = client.render("demo", np.eye(4))
    with Recording(path) as recording:
        recording.add(frame)
        print("begun", flush=True)
        while True:
            recording.add(frame)
"""


@pytest.mark.slow
def test_an_interrupt_in_the_middle_of_writing_leaves_a_whole_file(
    client_service: RunningService, tmp_path: Path
) -> None:
    for number in range(4):  # where it strikes is chance
        path = tmp_path / f"{number}.mcap"
        command = [sys.executable, "-c", INTERRUPTED, client_service.grpc, KEY, str(path)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == b"begun\n"
            process.send_signal(signal.SIGINT)
        counts = {len(decoded(path, f"/ultragray/{topic}")) for topic in ("bmode", "probe_pose", "confidence")}
        assert len(counts) == 1
        assert counts.pop() > 0
    assert len(list(tmp_path.iterdir())) == 4


def test_times_that_no_stamp_can_hold_are_refused(client: Any, tmp_path: Path) -> None:
    frame = client.render("demo", POSES[0], RenderSettings(height=8, width=8))
    with Recording(tmp_path / "times.mcap") as recording:
        for time_ns in (-1, 2**31 * 1_000_000_000, 0.5, True):
            with pytest.raises(errors.InvalidArgument, match="time_ns must be a whole number of nanoseconds"):
                recording.add(frame, time_ns=time_ns)
    assert not decoded(tmp_path / "times.mcap", "/ultragray/bmode")


def test_a_file_that_cannot_grow_is_one_error_and_leaves_nothing(client: Any, tmp_path: Path) -> None:
    frame = client.render("demo", POSES[0], RenderSettings(height=64, width=64))
    with (
        files_of_at_most(2000),
        pytest.raises(OSError, match="File too large"),
        Recording(tmp_path / "full.mcap") as recording,
    ):
        recording.add(frame)
    assert list(tmp_path.iterdir()) == []


def test_without_the_package_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "ultragray_client.recording.writer", raising=False)
    monkeypatch.setitem(sys.modules, "mcap_ros2.writer", None)
    with pytest.raises(errors.ExtraMissing, match=r"a recording needs mcap.*pip install 'ultragray-client\[mcap\]'"):
        Recording(tmp_path / "none.mcap")
    assert list(tmp_path.iterdir()) == []
