"""Scenes, datasets, jobs and workers, and recordings of frames beside the files of jobs."""

import json
import signal
import subprocess
import sys
from dataclasses import replace

import grpc
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from ultragray.installation import memory_bytes
from ultragray_client import (
    AroundSampler,
    Box,
    ConvexProbe,
    DatasetOptions,
    Display,
    JobState,
    LinearProbe,
    Needle,
    Recording,
    RenderJob,
    RenderSettings,
    ToolFrame,
    TrainJob,
    WorkerState,
    errors,
)
from ultragray_proto.v1 import jobs_pb2, jobs_pb2_grpc

from ..service.http.test_http_datasets import poisoned_files, released_files
from ..waiting import wait_until
from .conftest import KEY
from .test_client_render import moved

TRAINING = {"steps": 20, "max_gaussians": 40, "batch_size": 2}


@pytest.fixture(scope="module")
def client_service(working_service):
    """One with a worker."""
    return working_service


@pytest.fixture
def folder(tmp_path):
    released_files(tmp_path / "tiny")
    return tmp_path / "tiny"


@pytest.fixture
def name(request):
    """Of its own for each test."""
    return str(request.node.name).translate(str.maketrans("[]", "--"))


def test_scenes(client):
    entries = {entry.name: entry for entry in client.scenes.list()}
    assert {"demo", "second", "probeless", "truncated", "foreign", "empty"} <= set(entries)
    assert entries["demo"].error is None
    assert entries["demo"].gaussian_count == 400
    assert "truncated" in (entries["truncated"].error or "")
    scene = client.scenes.get("demo")
    assert (scene.gaussian_count, scene.centre_mm, scene.probe) == (400, (0.0, 0.0, 20.0), LinearProbe(40.0, 0.0, 40.0))
    assert (scene.training_pose_count, scene.training_position_max_mm) == (5, (0.0, 4.0, 0.0))
    assert [pose[1, 3] for pose in scene.training_poses] == [0.0, 2.0, 4.0]
    assert scene.metrics == {"psnr": 20.5}
    assert client.scenes.get("probeless").probe is None
    assert client.scenes.load("demo") == 1
    assert client.scenes.get("demo").loaded_processes == 1
    assert client.scenes.unload("demo") == 0
    with pytest.raises(errors.SceneNotFound):
        client.scenes.get("gone")


def test_the_life_of_a_dataset(client, folder, name):
    made = client.datasets.upload(name, folder, options=DatasetOptions(train_frames="0:6"))
    assert (made.name, made.kind, made.train_frames, made.val_frames) == (name, "released", 6, 3)
    assert (made.probe, made.options) == (LinearProbe(40.0, 0.0, 50.0), {"train_frames": "0:6"})
    assert client.datasets.get(name) == made
    assert made in client.datasets.list()
    assert client.datasets.contact_sheet(name).startswith(b"\x89PNG")
    assert client.datasets.upload(name, folder, options=DatasetOptions(train_frames="0:6")) == made
    with pytest.raises(errors.DatasetExists):
        client.datasets.upload(name, folder)
    client.datasets.delete(name)
    with pytest.raises(errors.DatasetNotFound):
        client.datasets.delete(name)


def test_uploads_that_are_refused(client, folder, name, tmp_path):
    for path in (tmp_path / "gone", folder / "conf.json"):
        with pytest.raises(errors.InvalidArgument, match="folder or an archive"):
            client.datasets.upload(name, path)
    for file, content in poisoned_files({path.name: path.read_bytes() for path in folder.iterdir()}).items():
        (folder / file).write_bytes(content)
    with pytest.raises(errors.DatasetInvalid, match=r"poses_train\.npy"):
        client.datasets.upload(name, folder)


def test_the_life_of_a_training(client, folder, name, tmp_path):
    client.datasets.upload(name, folder)
    job = client.jobs.submit(TrainJob(name, f"{name}.scene", settings=TRAINING, device="cpu"), request_id=name)
    assert (job.kind, job.specification.settings, job.request_id) == ("train", TRAINING, name)
    again = client.jobs.submit(TrainJob(name, f"{name}.scene", settings=TRAINING, device="cpu"), request_id=name)
    assert again.id == job.id
    with pytest.raises(errors.RequestIdConflict):
        client.jobs.submit(TrainJob(name, f"{name}.other", settings=TRAINING, device="cpu"), request_id=name)
    events = list(client.jobs.watch(job.id))
    done = [event.job for event in events if event.job][-1]
    assert (done.state, done.progress.step, done.error) == (JobState.SUCCEEDED, 20, None)
    assert {"metrics.json", "metrics.jsonl", "training_curve.png", "report.html"} < set(done.artifacts)
    assert done.state.final
    assert done == client.jobs.wait(job.id) == client.jobs.get(job.id)
    assert done in client.jobs.list(state="succeeded", kind="train")
    assert len(client.jobs.list(limit=1)) == 1
    assert isinstance(client.jobs.log(job.id), str)

    client.jobs.download(job.id, "metrics.json", tmp_path / "metrics.json")
    assert json.loads((tmp_path / "metrics.json").read_text())
    client.jobs.download(job.id, f"{name}.scene.ugr", tmp_path / "scene.ugr")
    assert (tmp_path / "scene.ugr").stat().st_size == client.scenes.get(f"{name}.scene").file_bytes
    with pytest.raises(errors.ArtifactNotFound):
        client.jobs.download(job.id, "gone", tmp_path / "gone")
    assert {path.name for path in tmp_path.iterdir()} == {"tiny", "metrics.json", "scene.ugr"}

    with pytest.raises(errors.JobFinished):
        client.jobs.cancel(job.id)
    with pytest.raises(errors.JobNotFinished):
        client.jobs.retry(job.id)
    client.jobs.delete(job.id)
    with pytest.raises(errors.JobNotFound):
        client.jobs.get(job.id)


def test_a_batch_of_frames_as_a_job(client, client_service, tmp_path):
    poses = np.tile(np.eye(4), (3, 1, 1))
    job = client.jobs.submit(
        RenderJob(scene="demo", poses=poses, height=8, width=6, outputs=("bmode", "echo"), dtype="uint8")
    )
    assert (job.pose_count, job.specification.outputs) == (3, ("bmode", "echo"))
    assert client.jobs.wait(job.id).state is JobState.SUCCEEDED
    client.jobs.download(job.id, "frames.npz", tmp_path / "frames.npz")
    with np.load(tmp_path / "frames.npz") as frames:
        assert frames["echo"].shape == (3, 8, 6)
    with client_service.channel() as channel:
        for offset in (-1, 1 << 40):
            part = jobs_pb2.DownloadArtifactRequest(job=job.id, name="frames.npz", offset=offset)
            with pytest.raises(grpc.RpcError, match="offset must be from 0 to"):
                list(jobs_pb2_grpc.JobServiceStub(channel).DownloadArtifact(part, metadata=[("x-api-key", KEY)]))
    shown = RenderJob(
        scene="demo",
        poses=poses,
        height=8,
        width=6,
        probe=ConvexProbe(60.0, 5.0, 40.0),
        display=Display(pixel_mm=0.5),
        tools=(
            Needle(tip_mm=(1.0, 0.0, 20.0), hub_mm=(-9.0, 0.0, 5.0), frame=ToolFrame.PROBE, opacity=0.0),
            Box(centre_mm=(0.0, 0.0, 30.0), size_mm=(4.0, 4.0, 2.0), label=4),
        ),
        ghost=0.5,
    )
    again = client.jobs.submit(shown)
    assert again.specification == replace(shown, poses=None, format="npz")
    assert again.request_id != job.request_id != ""
    with pytest.raises(errors.InvalidArgument, match="count"):
        client.jobs.submit(RenderJob(scene="demo", sampler=AroundSampler(count=0)))
    with pytest.raises(errors.UnknownOutput, match="shadow"):
        client.jobs.submit(RenderJob(scene="demo", poses=poses, outputs=("shadow",)))
    with pytest.raises(errors.InvalidPose, match=r"poses\[1\] must be"):
        client.jobs.submit(RenderJob(scene="demo", poses=[np.eye(4), np.eye(3)]))
    with pytest.raises(errors.InvalidArgument, match="state must be one of queued"):
        client.jobs.list(state="lost")


def test_cancel_and_retry(client):
    poses = np.tile(np.eye(4), (20_000, 1, 1))
    job = client.jobs.submit(RenderJob(scene="demo", poses=poses, height=300, width=300), priority=-5)
    cancelled = client.jobs.cancel(job.id)
    assert client.jobs.wait(job.id).state is JobState.CANCELLED
    assert client.jobs.cancel(job.id).state is JobState.CANCELLED
    again = client.jobs.retry(job.id)
    assert (again.retry_of, again.id != cancelled.id) == (job.id, True)
    with pytest.raises(errors.JobInUse):
        client.jobs.delete(again.id)
    client.jobs.cancel(again.id)
    client.jobs.wait(again.id)


def test_workers_rest_and_resume(client):
    (worker,) = wait_until(lambda: [one for one in client.workers.list() if one.state is WorkerState.IDLE])
    assert (worker.pid > 0, worker.device) == (True, "auto")
    try:
        (device,) = [one for one in worker.devices if one.name == "cpu"]
        assert device.memory_bytes == memory_bytes()
        assert worker.labels == {}
        assert client.workers.drain(worker.name).state is WorkerState.DRAINED
        assert client.workers.pause(worker.name).state is WorkerState.PAUSED
        assert client.workers.list()[0].state is WorkerState.PAUSED
    finally:
        assert client.workers.resume(worker.name).state in (WorkerState.IDLE, WorkerState.WORKING)
    with pytest.raises(errors.WorkerNotFound, match="there is no worker 'gone'"):
        client.workers.pause("gone")


COUNT = 30
POSES = np.stack([moved(x) for x in np.linspace(-4.0, 4.0, COUNT)])


def decoded(path, topic):
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [found.decoded_message for found in reader.iter_decoded_messages(topics=[topic])]


@pytest.mark.slow
@pytest.mark.parametrize("make_client", ["sync"], indirect=True)
def test_a_recording_is_the_file_of_the_job_that_renders_the_same(client, tmp_path):
    settings = {
        "height": 24,
        "width": 20,
        "outputs": ("bmode", "transmittance"),
        "probe": ConvexProbe(60.0, 40.0, 90.0),
        "display": Display(gain_db=3.0, depth_mm=30.0, flip=True),
        "tools": (Needle(tip_mm=(0.0, 0.0, 20.0), hub_mm=(10.0, 0.0, 5.0), frame=ToolFrame.PROBE),),
        "ghost": 0.2,
    }
    job = client.jobs.submit(RenderJob(scene="demo", poses=POSES, format="mcap", **settings))
    client.jobs.wait(job.id, timeout_s=300.0)
    client.jobs.download(job.id, "frames.mcap", tmp_path / "job.mcap")
    with Recording(tmp_path / "recorded.mcap") as recording:
        for frame in client.render_batch("demo", POSES, RenderSettings(**settings)):
            recording.add(frame)
    assert (tmp_path / "recorded.mcap").read_bytes() == (tmp_path / "job.mcap").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["job.mcap", "recorded.mcap"]


def test_a_stream_is_recorded_with_its_own_times_and_changes_of_geometry(client, tmp_path):
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


def test_what_came_before_an_error_is_kept(client, tmp_path):
    path = tmp_path / "kept.mcap"
    path.write_bytes(b"an older file")
    frame = client.render("demo", POSES[0], RenderSettings(height=8, width=8))
    recording = Recording(path)

    def interrupted():
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
def test_an_interrupt_in_the_middle_of_writing_leaves_a_whole_file(client_service, tmp_path):
    for number in range(2):  # where it strikes is chance
        path = tmp_path / f"{number}.mcap"
        command = [sys.executable, "-c", INTERRUPTED, client_service.grpc, KEY, str(path)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
            assert process.stdout.readline() == b"begun\n"
            process.send_signal(signal.SIGINT)
        counts = {len(decoded(path, f"/ultragray/{topic}")) for topic in ("bmode", "probe_pose", "confidence")}
        assert len(counts) == 1
        assert counts.pop() > 0
    assert len(list(tmp_path.iterdir())) == 2


def test_without_the_package_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.delitem(sys.modules, "ultragray_client.recording.writer", raising=False)
    monkeypatch.setitem(sys.modules, "mcap_ros2.writer", None)
    with pytest.raises(errors.ExtraMissing, match=r"a recording needs mcap.*pip install 'ultragray-client\[mcap\]'"):
        Recording(tmp_path / "none.mcap")
    assert list(tmp_path.iterdir()) == []
