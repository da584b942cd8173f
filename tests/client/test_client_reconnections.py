"""Connections that break off: streams, batches, downloads and watches go on, each pose with one frame."""

import signal
import threading
from concurrent import futures
from contextlib import nullcontext

import grpc
import numpy as np
import pytest

from ultragray_client import JobState, RenderJob, RenderSettings, errors
from ultragray_client.connection import Retries
from ultragray_client.conversations import Watch, download_into
from ultragray_client.exchange import Unanswered
from ultragray_client.transport import Connection, Deletion
from ultragray_proto.v1 import jobs_pb2, rendering_pb2

from ..waiting import Deadline
from .conftest import KEY
from .proxy import Proxy
from .test_client_render import moved
from .test_client_stream import is_shared

SMALL = RenderSettings(height=16, width=16)


def test_an_ordered_stream_gets_the_frame_of_each_pose_once(far_client, proxy):
    shifts = np.linspace(-4, 4, 300)
    with far_client.stream("demo", SMALL, shared_memory=False) as stream:
        proxy.cut_after(3000, 10_000, 10_000)  # somewhere in a frame; the 300 have 76,800 pixels

        def send():
            for x in shifts:
                stream.send(moved(x))
            stream.done_sending()

        sender = threading.Thread(target=send)
        sender.start()
        frames = list(stream)
        sender.join()
    assert [frame.sequence for frame in frames] == list(range(1, 301))
    assert [frame.pose[0, 3] for frame in frames] == shifts.tolist()
    assert {frame.dropped for frame in frames} == {0}
    assert proxy.cuts == 3
    assert 1 <= stream.reconnections <= 3  # a connection that is cut before it has brought a frame is not counted


def test_a_latest_stream_goes_on_with_the_newest_pose(far_client, proxy):
    frames = []
    with far_client.stream("demo", SMALL, mode="latest", shared_memory=False) as stream:
        for number, x in enumerate(np.linspace(-4, 4, 300), start=1):
            stream.send(moved(x))
            if number % 3 == 0:
                frames.append(stream.receive())
            if number in (60, 150):
                proxy.cut_after(0)
        stream.done_sending()
        frames += list(stream)
    sequences = [frame.sequence for frame in frames]
    assert sequences == sorted(set(sequences))
    assert sequences[-1] == 300
    for frame in frames:
        assert frame.pose[0, 3] == np.linspace(-4, 4, 300)[frame.sequence - 1]
    assert len(frames) + sum(frame.dropped for frame in frames) == 300
    assert stream.reconnections == proxy.cuts == 2


def test_errors_in_place_of_frames_come_once(far_client, proxy):
    told = []
    with far_client.stream("demo", SMALL, shared_memory=False) as stream:
        proxy.cut_after(6000)  # before the first pose: answers may come while others are sent
        for number in range(1, 41):
            stream.send(2 * np.eye(4) if number % 4 == 0 else moved(0.0))
        stream.done_sending()
        for _ in range(40):
            try:
                told.append((stream.receive().sequence, ""))
            except errors.InvalidPose as error:
                told.append((error.sequence or 0, error.reason))
        with pytest.raises(errors.StreamEnded):
            stream.receive()
    assert proxy.cuts == 1
    assert told == [(number, "INVALID_POSE" if number % 4 == 0 else "") for number in range(1, 41)]


@pytest.mark.parametrize("mode", ["ordered", "latest"])
def test_a_stream_with_shared_memory_goes_on_with_new_memory(far_client, proxy, mode):
    def frame_of(stream, x):
        stream.send(moved(x))
        return stream.receive()

    with far_client.stream("demo", SMALL, shared_memory=False) as ordinary:
        expected = [frame_of(ordinary, x)["bmode"] for x in range(12)]
    with far_client.stream("demo", SMALL, mode=mode, shared_memory=True) as stream:
        frames = [frame_of(stream, x) for x in range(6)]
        proxy.cut()
        end = Deadline(60)
        while stream.reconnections == 0:  # some frames may come before the service knows
            assert not end.passed
            np.testing.assert_array_equal(frame_of(stream, 6)["bmode"], expected[6])
        frames += [frame_of(stream, x) for x in range(6, 12)]
        assert stream.reconnections == 1
    assert all(map(is_shared, frames))
    for frame, pixels in zip(frames, expected, strict=True):
        np.testing.assert_array_equal(frame["bmode"], pixels)


@pytest.mark.parametrize(
    ("make_client", "number", "mode"),
    [("sync", signal.SIGKILL, "ordered"), ("asyncio", signal.SIGTERM, "latest")],
    indirect=["make_client"],
)
def test_a_stream_goes_on_at_another_service(make_client, start_service, number, mode):
    first, second = start_service(), start_service()
    proxy = Proxy(first.grpc)
    client = make_client(proxy.address, timeout_s=300.0)
    with client.stream("demo", SMALL, mode=mode) as stream:
        for x in range(5):
            stream.send(moved(x))
            stream.receive()
        proxy.lead_to(second.grpc)
        stream.send(moved(5.0))
        first.process.send_signal(number)
        frames = [stream.receive()]
        while not stream.reconnections:
            stream.send(moved(6.0))
            frames.append(stream.receive())
        stream.send(moved(7.0))
        frames.append(stream.receive())
    assert [frame.sequence for frame in frames] == list(range(6, 6 + len(frames)))
    assert [frame.pose[0, 3] for frame in frames] == [5.0, *[6.0] * (len(frames) - 2), 7.0]
    proxy.close()


@pytest.mark.parametrize("mode", ["ordered", "latest"])
def test_patience_ends(make_client, client_service, mode):
    proxy = Proxy(client_service.grpc)
    client = make_client(proxy.address, api_key=KEY)
    with client.stream("demo", SMALL, mode=mode, reconnect_s=0.5) as stream:
        stream.send(moved(0.0))
        assert stream.receive().sequence == 1
        proxy.close()
        with pytest.raises(errors.Unreachable):
            stream.receive()
        with pytest.raises(errors.Unreachable):
            stream.send(moved(0.0))
    with pytest.raises(errors.InvalidArgument, match="reconnect_s"):
        client.stream("demo", reconnect_s=-1.0)


def test_a_pose_is_sent_again_with_what_is_left_of_its_time(monkeypatch):
    now = 1000.0
    monkeypatch.setattr("ultragray_client.exchange.time.monotonic", lambda: now)
    unanswered = Unanswered(newest_alone=False)
    unanswered.add(rendering_pb2.RenderStreamRequest(sequence=1, timeout_ms=5000.0))
    unanswered.add(rendering_pb2.RenderStreamRequest(sequence=2, timeout_ms=1.0))
    unanswered.add(rendering_pb2.RenderStreamRequest(sequence=3))
    now += 0.05
    first, second, third = unanswered.again()
    assert first.timeout_ms == pytest.approx(4950.0)
    assert 0.0 < second.timeout_ms < 0.01  # which the service refuses, as it came too late
    assert not third.HasField("timeout_ms")
    unanswered.answered(rendering_pb2.Frame(sequence=2))
    assert [message.sequence for message in unanswered.again()] == [1, 3]


class _Recorder(grpc.GenericRpcHandler):
    """Notes the metadata of every call, and refuses it."""

    def __init__(self):
        self.scenes = {}

    def service(self, details):
        named = [value for key, value in details.invocation_metadata if key == "x-ultragray-scene"]
        self.scenes.setdefault(details.method.rpartition("/")[2], []).extend(named)
        return None


def test_every_call_about_a_scene_names_it_to_proxies(make_client):
    recorder = _Recorder()
    server = grpc.server(futures.ThreadPoolExecutor(2), handlers=[recorder])
    client = make_client(f"127.0.0.1:{server.add_insecure_port('127.0.0.1:0')}")
    server.start()
    about = "liver 2/ö"
    with client.stream(about) as stream:
        calls = [
            stream.receive,
            lambda: client.render(about, moved(0.0)),
            lambda: next(client.render_batch(about, [moved(0.0)])),
            lambda: client.scenes.get(about),
            lambda: client.scenes.load(about),
            lambda: client.scenes.list(),
            lambda: client.jobs.list(),
        ]
        for call in calls:
            with pytest.raises(errors.ClientError, match="Method"):
                call()
    server.stop(None)
    quoted = ["liver%202%2F%C3%B6"]
    expected = dict.fromkeys(("RenderStream", "Render", "RenderBatch", "GetScene", "LoadScene"), quoted)
    assert recorder.scenes == {**expected, "ListScenes": [], "ListJobs": []}


@pytest.fixture(scope="module")
def client_service(working_service):
    """One with a worker."""
    return working_service


def test_a_batch_goes_on(far_client, proxy):
    poses = np.tile(np.eye(4), (120, 1, 1))
    poses[:, 0, 3] = np.linspace(-4, 4, 120)
    batch = far_client.render_batch("demo", poses, RenderSettings(height=64, width=64))
    frames = [next(batch)]
    proxy.cut_after(150_000)
    frames += list(batch)
    assert proxy.cuts == 1
    assert [frame.sequence for frame in frames] == list(range(120))
    assert [frame.pose[0, 3] for frame in frames] == poses[:, 0, 3].tolist()


def test_a_download_goes_on_and_is_whole(far_client, client, proxy, tmp_path):
    poses = np.tile(np.eye(4), (60, 1, 1))
    job = client.jobs.submit(
        RenderJob(scene="demo", poses=poses, height=200, width=200, dtype="float32", outputs=("bmode", "echo"))
    )
    assert client.jobs.wait(job.id, timeout_s=300).state is JobState.SUCCEEDED
    client.jobs.download(job.id, "frames.npz", tmp_path / "straight.npz")
    proxy.cut_after(8_000_000)
    far_client.jobs.download(job.id, "frames.npz", tmp_path / "broken.npz")
    assert proxy.cuts == 1
    assert (tmp_path / "broken.npz").read_bytes() == (tmp_path / "straight.npz").read_bytes()
    assert {path.name for path in tmp_path.iterdir()} == {"straight.npz", "broken.npz"}


def test_a_watch_goes_on(far_client, client, proxy):
    job = client.jobs.submit(RenderJob(scene="demo", poses=np.tile(np.eye(4), (20_000, 1, 1)), height=300, width=300))
    events = far_client.jobs.watch(job.id)
    assert next(events).job.id == job.id
    proxy.cut_after(0)
    cancel = threading.Timer(0.5, client.jobs.cancel, (job.id,))
    cancel.start()
    assert [event.job.state for event in events if event.job][-1] is JobState.CANCELLED
    cancel.join()  # its answer may come after the event
    assert proxy.cuts == 1


def test_a_file_that_does_not_come_leaves_nothing(tmp_path):
    def half():
        with download_into("job", "file", tmp_path / "file") as download:
            download.keep(jobs_pb2.ArtifactChunk(data=b"half", file_bytes=8))
            request = download.request()
            assert request.offset == 4
            download.end_of_call()

    with pytest.raises(errors.Unreachable, match="after 4 bytes"):
        half()
    assert not list(tmp_path.iterdir())


def test_a_log_is_not_told_twice():
    watch, retries = Watch("job"), Retries(None, patience_s=60.0)

    def new(log):
        return watch.take(jobs_pb2.JobEvent(log=log)).log

    def break_off():
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
def test_a_deletion_that_had_worked_is_no_error(failures, is_refused):
    left = list(failures)

    class Failing(Connection):
        async def attempt(self, *_):
            if left:
                raise left.pop(0)("no")

        async def rest(self, seconds): ...

    connection = Failing("127.0.0.1:1", None, None, 60.0)
    with pytest.raises(errors.ClientError) if is_refused else nullcontext():
        connection.answer(Deletion("JobService.DeleteJob", None, job="a"))
    assert not left
