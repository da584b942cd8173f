"""Streams whose frames come through memory that is shared with the service."""

from __future__ import annotations

import ctypes
import gc
import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ultragray_client import Frame, RenderSettings, errors
from ultragray_client import exchange as shared_memory
from ultragray_client.exchange import SLOTS, SharedMemory
from ultragray_proto.v1 import rendering_pb2

from ..service.conftest import ROOT, RunningService
from ..waiting import Deadline, wait_until
from .test_client_render import moved

SMALL = RenderSettings(height=16, width=16)


def is_shared(frame: Frame) -> bool:
    """Whether the pixels lie in shared memory, rather than in a message."""
    owner: Any = next(iter(frame.arrays.values()))
    while isinstance(owner, np.ndarray):
        owner = owner.base
    return isinstance(getattr(owner, "obj", owner), ctypes.Array)


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A folder in place of /dev/shm, so that nobody else makes files there; the service does not look there."""
    monkeypatch.setattr(shared_memory, "_FOLDER", tmp_path)
    return tmp_path


@pytest.mark.parametrize(("mode", "encoding"), [("ordered", "uint8"), ("latest", "float32")])
def test_frames_are_those_of_an_ordinary_stream(client: Any, encoding: str, mode: str) -> None:
    settings = RenderSettings(outputs=("coverage", "bmode", "transmittance"), encoding=encoding)
    with (
        client.stream("demo", settings) as ordinary,
        client.stream("demo", settings, mode=mode, shared_memory=True) as shared,
    ):
        for x in range(40):
            one, other = (_next(stream, x) for stream in (ordinary, shared))
            assert (is_shared(one), is_shared(other)) == (False, True)
            assert list(one.arrays) == list(other.arrays) == ["coverage", "bmode", "transmittance"]
            for name, array in one.arrays.items():
                assert other[name].dtype == array.dtype
                assert not other[name].flags.writeable
                np.testing.assert_array_equal(other[name], array)
            np.testing.assert_array_equal(one.pose, other.pose)
            assert (other.sequence, other.scene_sha256, other.picture) == (x + 1, one.scene_sha256, one.picture)


def _next(stream: Any, x_mm: float) -> Frame:
    stream.send(moved(x_mm))
    frame: Frame = stream.receive()
    return frame


def test_frames_that_are_held_are_not_overwritten(client: Any) -> None:
    with client.stream("demo", SMALL) as stream:
        expected = [_next(stream, x)["bmode"] for x in range(SLOTS + 4)]
    with client.stream("demo", SMALL, shared_memory=True) as stream:
        held: list[Any] = []
        shared = []
        for x in range(SLOTS + 4):
            frame = _next(stream, x)
            shared.append(is_shared(frame))
            held.append(frame["bmode"][2:, 3:])  # a view of the array alone keeps the slot
        assert shared == [True] * SLOTS + [False] * 4
        del frame
        for kept, array in zip(held, expected, strict=True):
            np.testing.assert_array_equal(kept, array[2:, 3:])
        del held[3], kept
        last = _next(stream, 3)
        assert is_shared(last)
        assert not is_shared(_next(stream, 4))
    np.testing.assert_array_equal(last["bmode"], expected[3])  # after the end of the stream, too
    np.testing.assert_array_equal(held[5], expected[6][2:, 3:])


def test_frames_that_a_latest_stream_skips_free_their_slots(client: Any) -> None:
    skipped = 0
    end = Deadline(60)
    with client.stream("demo", SMALL, mode="latest", shared_memory=True) as stream:
        while skipped <= SLOTS:
            assert not end.passed
            for x in range(8):  # of which some frames come, and take each other's place
                stream.send(moved(x))
            frame = stream.receive()
            skipped += frame.dropped
            assert is_shared(frame)


def test_ordered_frames_may_be_read_late(client: Any) -> None:
    """More of them than there are slots: the rest comes in messages."""
    with client.stream("demo", SMALL, shared_memory=True) as stream:
        for x in range(60):
            stream.send(moved(x))
        stream.done_sending()
        frames = list(stream)
    assert [frame.pose[0, 3] for frame in frames] == list(range(60))
    assert sum(is_shared(frame) for frame in frames) == SLOTS


def test_what_the_service_refuses_is_told(client: Any, folder: Path) -> None:
    for _ in range(10):  # a pose may be on its way when the refusal comes, or not yet, or have arrived
        with client.stream("demo", SMALL, shared_memory=True) as stream:
            with suppress(errors.StreamEnded, errors.InvalidArgument):
                for x in range(5):
                    stream.send(moved(x))
            with pytest.raises(errors.InvalidArgument, match="shared_memory") as refused:
                stream.receive()
            assert refused.value.field == "shared_memory.name"
    assert list(folder.iterdir()) == []


def test_a_system_without_such_memory_is_told(client: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(shared_memory, "_FOLDER", tmp_path / "absent")
    with pytest.raises(errors.InvalidArgument, match="shared_memory cannot be had on this system") as refused:
        client.stream("demo", shared_memory=True)
    assert refused.value.field == "shared_memory"


def test_a_memory_that_is_not_used_leaves_no_file(folder: Path) -> None:
    memory = SharedMemory()
    (file,) = folder.iterdir()
    assert file.stat().st_mode & 0o777 == 0o600
    assert file.stat().st_blocks * 512 <= 2 * 4096  # pages that nothing was written to take no memory
    del memory
    gc.collect()
    assert list(folder.iterdir()) == []


def test_the_memory_of_a_stream_goes_with_its_last_frame(client: Any, client_service: RunningService) -> None:
    def mapped() -> int:
        gc.collect()
        return Path("/proc/self/maps").read_text().count("/dev/shm/ultragray-")

    wait_until(lambda: mapped() == 0)
    with client.stream("demo", SMALL, shared_memory=True) as stream:
        frame = _next(stream, 0)
        assert mapped() == 1
    del stream
    assert mapped() == 1
    del frame
    wait_until(lambda: mapped() == 0)


FORKED = """
import os
from ultragray_client.exchange import SharedMemory
from ultragray_proto.v1 import rendering_pb2

memory = SharedMemory()
memory._map[32] = 0  # as the service does
pixels = memory.taken(rendering_pb2.Frame(shared_data=rendering_pb2.SharedData(slot=0, bytes=100)))
child = os.fork()
if child == 0:
    del pixels
    os._exit(memory._map[32])
assert os.waitpid(child, 0)[1] == 0
del pixels
assert memory._map[32] == 1
"""


def test_a_child_process_does_not_free_what_its_parent_holds() -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(str(ROOT / name) for name in ("client", "proto"))}
    subprocess.run([sys.executable, "-c", FORKED], env=environment, check=True)


def test_frames_of_another_slot_than_there_is_are_refused(folder: Path) -> None:
    memory = SharedMemory()
    with pytest.raises(ValueError, match="Buffer size too small"):
        memory.taken(rendering_pb2.Frame(shared_data=rendering_pb2.SharedData(slot=SLOTS, bytes=100)))
