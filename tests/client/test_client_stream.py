"""Streams of poses, whose frames may come through memory that is shared with the service."""

import ctypes
import errno
import gc
import os
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from ultragray_client import AsyncClient, RenderSettings, errors
from ultragray_client import exchange as shared_memory
from ultragray_client.exchange import MAX_WAITING, SLOTS, PoseExchange, SharedMemory
from ultragray_client.frames import received_frame, settings_message
from ultragray_proto.v1 import geometry_pb2, rendering_pb2, scenes_pb2

from ..service.conftest import ROOT
from ..waiting import Deadline, wait_until
from .conftest import KEY
from .test_client_render import moved


def test_an_ordered_stream_answers_every_pose(client):
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


def test_a_latest_stream_counts_what_it_drops(client):
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


def test_latency_counts_from_the_measurement(client):
    with client.stream("demo", RenderSettings(height=8, width=8)) as stream:
        stream.send(moved(0.0), measured_ns=time.monotonic_ns() - 5_000_000_000)
        assert stream.receive().latency_ms > 5000.0


def test_frames_are_those_of_when_they_are_seen(client):
    begun_ns, frames, is_foretold = time.monotonic_ns(), [], False
    with client.stream("demo", RenderSettings(height=8, width=8), seen_after_ms=100.0) as stream:
        deadline = Deadline(60)
        # Of a motion 1/(1 + 2/n) is believed in after n predictions in the last seconds, few while a machine is busy.
        while len(frames) < 60 or frames[-60].prediction.error_mm is None or not is_foretold:
            measured_ns = time.monotonic_ns() - 20_000_000
            x_mm = 2e-8 * (measured_ns - begun_ns)  # 20 mm/s
            stream.send(moved(x_mm), measured_ns=measured_ns)
            frames.append(stream.receive())
            motion_mm = 0.02 * frames[-1].prediction.ahead_ms
            is_foretold = frames[-1].pose[0, 3] - x_mm == pytest.approx(motion_mm, rel=0.1)
            assert not deadline.passed
    assert frames[-1].prediction.ahead_ms > 100.0 + 20.0
    with client.stream("demo", RenderSettings(height=8, width=8)) as stream:
        stream.send(moved(0.0))
        assert stream.receive().prediction is None
    with pytest.raises(errors.InvalidArgument, match="seen_after_ms must be from 0 to 1000, got -1"):
        client.stream("demo", seen_after_ms=-1.0)
    with client.stream("demo", RenderSettings(height=8, width=8), seen_after_ms=20.0) as stream:
        for off_s, told in ((-1000.0, "1,000 s ago"), (1e9, "ahead")):
            with pytest.raises(errors.InvalidArgument, match=told) as caught:
                stream.send(moved(0.0), measured_ns=time.monotonic_ns() + round(1e9 * off_s))
            assert caught.value.field == "measured_ns"


def test_the_clock_of_the_client_is_told_beside_the_services(client):
    with client.stream("demo", RenderSettings(height=8, width=8)) as stream:
        for _ in range(5):
            stream.send(moved(0.0))
            frame = stream.receive()
    ahead_ms = 1e3 * (time.monotonic() - time.time())
    assert abs(frame.clock.offset_ms - ahead_ms) <= frame.clock.uncertainty_ms + 50.0


def test_a_pose_that_gets_no_frame_does_not_end_a_stream(client):
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


def test_refused_settings_are_told_first(client):
    with client.stream("gone") as stream:
        stream.send(moved(0.0))
        with pytest.raises(errors.SceneNotFound):
            stream.receive()
    with pytest.raises(errors.InvalidArgument, match="newest"):
        client.stream("demo", mode="newest")


def test_a_service_that_stops_ends_a_stream_that_is_not_to_reconnect(make_client, start_service):
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


def test_what_was_dropped_before_an_error_is_told_with_the_next_frame():
    exchange = PoseExchange(settings_message("demo", None), "latest")

    def arriving(message):
        return exchange.arrived(received_frame(message.SerializeToString()))

    error = scenes_pb2.Error(reason="DEADLINE_EXCEEDED", detail="late")
    with pytest.raises(errors.DeadlineExceeded):
        exchange.frame(arriving(rendering_pb2.Frame(sequence=3, error=error, dropped=2)))
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
    assert exchange.frame(arriving(answer), dropped_here=4).dropped == 7
    assert exchange.frame(arriving(answer)).dropped == 1


def test_a_latest_stream_may_be_read_before_anything_is_sent(client):
    with client.stream("demo", RenderSettings(height=8, width=8), mode="latest") as stream:
        frames = []
        reader = threading.Thread(target=lambda: frames.append(stream.receive()))
        reader.start()
        stream.send(moved(0.0))
        reader.join()
        assert frames[0].sequence == 1


SMALL = RenderSettings(height=16, width=16)


def is_shared(frame):
    """Whether the pixels lie in shared memory, rather than in a message."""
    owner = next(iter(frame.arrays.values()))
    while isinstance(owner, np.ndarray):
        owner = owner.base
    return isinstance(getattr(owner, "obj", owner), ctypes.Array)


@pytest.fixture
def folder(monkeypatch):
    """A folder in place of /dev/shm, so that nobody else makes files there; the service does not look there."""
    with tempfile.TemporaryDirectory() as name:  # a short one, as names of sockets must be
        monkeypatch.setattr(shared_memory, "_FOLDER", Path(name))
        yield Path(name)


@pytest.mark.parametrize(("mode", "encoding"), [("ordered", "uint8"), ("latest", "float32")])
def test_frames_are_those_of_an_ordinary_stream(client, encoding, mode):
    settings = RenderSettings(outputs=("coverage", "bmode", "transmittance"), encoding=encoding)
    with (
        client.stream("demo", settings, shared_memory=False) as ordinary,
        client.stream("demo", settings, mode=mode, shared_memory=True) as shared,
    ):
        for x in range(40):
            one, other = (frame_at(stream, x) for stream in (ordinary, shared))
            assert (is_shared(one), is_shared(other)) == (False, True)
            assert list(one.arrays) == list(other.arrays) == ["coverage", "bmode", "transmittance"]
            for name, array in one.arrays.items():
                assert other[name].dtype == array.dtype
                assert not other[name].flags.writeable
                np.testing.assert_array_equal(other[name], array)
            np.testing.assert_array_equal(one.pose, other.pose)
            assert (other.sequence, other.scene_sha256, other.picture) == (x + 1, one.scene_sha256, one.picture)


def frame_at(stream, x_mm):
    stream.send(moved(x_mm))
    return stream.receive()


def test_frames_that_are_held_are_not_overwritten(client):
    with client.stream("demo", SMALL, shared_memory=False) as stream:
        expected = [frame_at(stream, x)["bmode"] for x in range(SLOTS + 4)]
    with client.stream("demo", SMALL, shared_memory=True) as stream:
        held = []
        shared = []
        for x in range(SLOTS + 4):
            frame = frame_at(stream, x)
            shared.append(is_shared(frame))
            held.append(frame["bmode"][2:, 3:])  # a view of the array alone keeps the slot
        assert shared == [True] * SLOTS + [False] * 4
        del frame
        for kept, array in zip(held, expected, strict=True):
            np.testing.assert_array_equal(kept, array[2:, 3:])
        del held[3], kept
        last = frame_at(stream, 3)
        assert is_shared(last)
        assert not is_shared(frame_at(stream, 4))
    np.testing.assert_array_equal(last["bmode"], expected[3])  # after the end of the stream, too
    np.testing.assert_array_equal(held[5], expected[6][2:, 3:])


def test_frames_that_a_latest_stream_skips_free_their_slots(client):
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


def test_what_the_service_refuses_is_told(client, folder):
    for _ in range(10):  # a pose may be on its way when the refusal comes, or not yet, or have arrived
        with client.stream("demo", SMALL, shared_memory=True) as stream:
            with suppress(errors.StreamEnded, errors.InvalidArgument):
                for x in range(5):
                    stream.send(moved(x))
            with pytest.raises(errors.InvalidArgument, match="shared_memory") as refused:
                stream.receive()
            assert refused.value.field == "shared_memory.name"
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("reconnect_s", [None, 0.0])
@pytest.mark.parametrize("mode", ["ordered", "latest"])
def test_unless_it_is_insisted_on_frames_come_without_it_where_the_service_refuses_it(
    client, folder, mode, reconnect_s
):
    for _ in range(10):
        with client.stream("demo", SMALL, mode=mode, reconnect_s=reconnect_s) as stream:
            frame = frame_at(stream, 1)
            assert not is_shared(frame)
            assert (frame.sequence, stream.reconnections, frame.dropped) == (1, 0, 0)
            assert frame_at(stream, 2).sequence == 2
    assert list(folder.iterdir()) == []


async def test_likewise_for_asyncio(client_service, folder):
    for reconnect_s in (None, 0.0):
        async with (
            AsyncClient(client_service.grpc, api_key=KEY) as client,
            client.stream("demo", SMALL, reconnect_s=reconnect_s) as stream,
        ):
            for x in (1, 2):
                await stream.send(moved(x))
                frame = await stream.receive()
                assert (is_shared(frame), frame.sequence, stream.reconnections) == (False, x, 0)


@pytest.mark.parametrize("mode", ["ordered", "latest"])
@pytest.mark.parametrize("reconnect_s", [None, 0.0])
def test_nobody_need_read_for_poses_to_go_without_it(client, folder, mode, reconnect_s):
    with client.stream("demo", SMALL, mode=mode, reconnect_s=reconnect_s) as stream:
        for x in range(3 * MAX_WAITING):
            stream.send(moved(x / 100))
        stream.done_sending()
        frames = list(stream)
    assert len(frames) + sum(frame.dropped for frame in frames) == 3 * MAX_WAITING
    assert frames[-1].sequence == 3 * MAX_WAITING
    assert stream.reconnections == 0


async def test_a_service_that_is_not_there_is_told_to_who_only_sends():
    async with AsyncClient("127.0.0.1:1") as client, client.stream("demo", SMALL, reconnect_s=0.0) as stream:
        with pytest.raises(errors.StreamEnded):
            await stream.send(moved(0.0))


def test_refused_settings_are_told_where_it_is_refused_too(client, folder):
    with client.stream("missing", SMALL) as stream:
        stream.done_sending()
        with pytest.raises(errors.SceneNotFound):
            stream.receive()


def test_unless_it_is_turned_off_frames_of_this_host_come_through_it(client, client_service, monkeypatch, tmp_path):
    with client.stream("demo", SMALL) as stream:
        assert is_shared(frame_at(stream, 1))
    monkeypatch.setattr(shared_memory, "_FOLDER", tmp_path / "absent")
    with client.stream("demo", SMALL) as stream:
        assert not is_shared(frame_at(stream, 1))


def test_a_system_without_such_memory_is_told(client, monkeypatch, tmp_path):
    monkeypatch.setattr(shared_memory, "_FOLDER", tmp_path / "absent")
    with pytest.raises(errors.InvalidArgument, match="shared_memory cannot be had on this system") as refused:
        client.stream("demo", shared_memory=True)
    assert refused.value.field == "shared_memory"


def test_a_memory_that_is_not_used_leaves_no_file(folder):
    memory = SharedMemory()
    file, listener = sorted(folder.iterdir())
    assert listener.is_socket()
    assert {one.stat().st_mode & 0o777 for one in (file, listener)} == {0o600}
    assert file.stat().st_blocks * 512 <= 2 * 4096  # pages that nothing was written to take no memory
    del memory
    gc.collect()
    assert list(folder.iterdir()) == []


def test_a_memory_without_a_socket_leaves_nothing(folder, monkeypatch):
    def none_left(family):
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(shared_memory.socket, "socket", none_left)
    before = os.listdir("/proc/self/fd")
    with pytest.raises(errors.InvalidArgument, match="Too many open files"):
        SharedMemory()
    assert list(folder.iterdir()) == []
    assert os.listdir("/proc/self/fd") == before


def test_the_memory_of_a_stream_goes_with_its_last_frame(client, client_service):
    def mapped():
        gc.collect()
        return Path("/proc/self/maps").read_text().count("/dev/shm/ultragray-")

    wait_until(lambda: mapped() == 0)
    with client.stream("demo", SMALL, shared_memory=True) as stream:
        frame = frame_at(stream, 0)
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


def test_a_child_process_does_not_free_what_its_parent_holds():
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(str(ROOT / name) for name in ("client", "proto"))}
    subprocess.run([sys.executable, "-c", FORKED], env=environment, check=True)
