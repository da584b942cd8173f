"""Recordings through the doors of a real service, and the scene that a real worker lets grow from one meanwhile."""

from __future__ import annotations

import json
import os
import signal
import threading
from dataclasses import replace

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosedError
from websockets.sync.client import connect

from ultragray_client import Client, LiveJob, RealFrame, RecordingSettings, errors
from ultragray_client import LinearProbe as ClientProbe
from ultragray_service.access.keys import KeyStore
from ultragray_service.access.principals import Role
from ultragray_workers.jobs.database import JobDatabase

from ..waiting import wait_until
from ..workers.jobs.conftest import RunningWorker

SIDE = 24
PROBE = {"kind": "linear", "width_mm": 20.0, "near_mm": 0.0, "far_mm": 25.0}
BODY = {"probe": PROBE, "image_height": SIDE, "image_width": SIDE}
SETTINGS = RecordingSettings(ClientProbe(20.0, 0.0, 25.0), SIDE, SIDE)


def pose_of(number):
    pose = np.eye(4)
    pose[1, 3] = 0.4 * number
    return pose


def image_of(number):
    x, z = np.meshgrid(np.linspace(-1, 1, SIDE), np.linspace(0, 1, SIDE))
    ball = 140.0 * np.exp(-((x - 0.02 * number) ** 2 + (z - 0.4) ** 2) / 0.1)
    noise = np.random.default_rng(number).normal(50.0, 4.0, (SIDE, SIDE))
    return np.clip(ball + noise, 0, 255).astype(np.uint8)


def frame_of(number, **beside):
    return RealFrame(image_of(number), pose_of(number), time_s=0.1 * number, **beside)


def message_of(number, image=None, pose=None):
    head = {"pose": {"matrix": (pose_of(number) if pose is None else pose).tolist()}, "number": number}
    text = json.dumps(head).encode()
    return len(text).to_bytes(4, "little") + text + (image_of(number).tobytes() if image is None else image)


@pytest.fixture(scope="module")
def service(start_service, artifacts):
    return start_service(artifact_folder=artifacts)


@pytest.fixture
def begun(http, request):
    name = f"sweep-{abs(hash(request.node.name))}"
    assert http.put(f"/v1/recordings/{name}", json=BODY).status_code == 200
    return name


def post(http, name, body):
    return http.post(
        f"/v1/recordings/{name}/frames", content=body, headers={"content-type": "application/octet-stream"}
    )


def test_frames_are_posted_one_by_one_and_become_a_dataset(http, begun):
    for number in (0, 1, 1, 2, 3, 5, 6):
        told = post(http, begun, message_of(number))
        assert told.status_code == 200, told.text
    assert (told.json()["frames"], told.json()["next_number"]) == (6, 7)
    assert http.get(f"/v1/datasets/{begun}").status_code == 404  # it is still open
    record = http.post(f"/v1/recordings/{begun}:finish").json()
    assert (record["train_frames"], record["val_frames"]) == (5, 1)
    assert any("lost on the way" in warning for warning in record["warnings"])
    assert http.get(f"/v1/recordings/{begun}").status_code == 404
    assert http.get(f"/v1/datasets/{begun}").json() == record
    assert http.post(f"/v1/recordings/{begun}:finish").json() == record  # its answer may have been lost on the way
    assert http.post(f"/v1/recordings/{begun}-2:finish").json()["reason"] == "DATASET_NOT_FOUND"


@pytest.mark.parametrize(
    ("body", "reason", "field"),
    [
        (b"\1\0", "INVALID_ARGUMENT", None),
        (message_of(0, image=b"\0" * 7), "INVALID_ARGUMENT", "image"),
        (message_of(0, image=bytes(SIDE * SIDE)), "INVALID_ARGUMENT", "image"),
        (message_of(0, pose=np.zeros((4, 4))), "INVALID_POSE", "pose.matrix"),
    ],
)
def test_a_frame_that_cannot_be_recorded_is_refused(http, begun, body, reason, field):
    told = post(http, begun, body)
    assert (told.status_code, told.json()["reason"], told.json()["field"]) == (422, reason, field)


def test_the_name_of_a_recording_is_taken(http, begun):
    assert http.put(f"/v1/recordings/{begun}", json={**BODY, "image_height": 32}).json()["reason"] == "DATASET_EXISTS"
    assert http.post(f"/v1/datasets/{begun}:simulate").json()["reason"] == "DATASET_EXISTS"
    assert http.put("/v1/recordings/..", json=BODY).status_code in (404, 422)


def test_over_a_websocket_bad_frames_are_told_and_the_others_go_on(service, http, begun):
    with connect(f"{service.http.replace('http', 'ws', 1)}/v1/recordings/{begun}/stream") as socket:
        assert json.loads(socket.recv())["recording"]["frames"] == 0
        assert post(http, begun, message_of(0)).json()["reason"] == "RECORDING_TAKEN"
        socket.send(message_of(0))
        socket.send(message_of(1, image=b"nonsense"))
        socket.send(message_of(2))
        socket.send("")
        answers = [json.loads(answer) for answer in socket]
    assert answers[-1]["recording"]["frames"] == 2
    assert [(one["refused_number"], one["error"]["field"]) for one in answers if one["error"]] == [(1, "image")]


def test_a_frame_that_cannot_be_read_is_told_with_its_own_number(service, http, begun):
    sheared, nameless = np.eye(4), message_of(5, pose=np.zeros((4, 4))).replace(b'"number": 5', b'"number":-5')
    sheared[0, 1] = 0.5
    heads = {4: {"number": 4}, 6: {"number": 6, "pose": None}, None: ["number"]}
    texts = {number: json.dumps(head).encode() for number, head in heads.items()}
    bad = {number: len(text).to_bytes(4, "little") + text + b"image" for number, text in texts.items()}
    with connect(f"{service.http.replace('http', 'ws', 1)}/v1/recordings/{begun}/stream") as socket:
        for message in (message_of(3, pose=sheared), *bad.values(), nameless, b"\1\0", "hello", message_of(7), ""):
            socket.send(message)
        answers = [json.loads(answer) for answer in socket]
    assert [one["refused_number"] for one in answers if one["error"]] == [3, 4, 6, *[None] * 4]
    assert answers[-1]["recording"]["frames"] == 1


def test_the_client_is_told_which_pose_is_none(client, begun):
    lost = [replace(frame_of(number), pose=np.full((4, 4), np.nan)) for number in (2, 5)]
    frames = [frame_of(0), frame_of(1), lost[0], frame_of(3), frame_of(4), lost[1]]  # the last one is not stored either
    answers = list(client.recordings.record(begun, frames))
    assert [one.error.sequence for one in answers if one.error is not None] == [2, 5]
    assert answers[-1].recording.frames == 4


def test_the_client_records_what_an_iterator_gives_and_goes_on_later(client, begun):
    first = list(client.recordings.record(begun, map(frame_of, range(4))))
    assert first[-1].recording.frames == 4
    bad = RealFrame(np.zeros((SIDE, SIDE), np.uint8), pose_of(5))
    later = list(client.recordings.record(begun, iter([frame_of(4), bad, frame_of(6)])))
    assert later[-1].recording.frames == 6
    assert [one.error.sequence for one in later if one.error is not None] == [5]
    assert client.recordings.get(begun).next_number == 7
    client.recordings.delete(begun)
    with pytest.raises(errors.DatasetNotFound):
        client.recordings.get(begun)


def test_the_client_is_told_of_a_second_sweep_that_counts_from_0_again(client, begun):
    list(client.recordings.record(begun, map(frame_of, range(4))))
    second = (replace(frame_of(number), number=number - 4) for number in range(4, 7))
    answers = list(client.recordings.record(begun, second))
    told = [(one.error.sequence, one.error.field) for one in answers if one.error is not None]
    assert told == [(0, "number"), (1, "number"), (2, "number")]
    assert answers[-1].recording.frames == 4


def test_a_service_that_is_killed_between_frames_loses_none_that_it_acknowledged(start_service, tmp_path):
    port = 0
    service = start_service(artifact_folder=tmp_path, cold=True)
    port = int(service.grpc.rpartition(":")[2])
    sent, go_on = threading.Event(), threading.Event()

    def frames():
        yield from map(frame_of, range(5))
        sent.set()
        go_on.wait()
        yield from map(frame_of, range(5, 8))

    with Client(service.grpc) as client:
        client.recordings.begin("liver", SETTINGS)
        answers = client.recordings.record("liver", frames())
        while next(answers).recording.frames < 5:
            pass
        os.kill(service.process.pid, signal.SIGKILL)
        service.process.wait()
        start_service(artifact_folder=tmp_path, cold=True, grpc_port=port)
        go_on.set()
        assert list(answers)[-1].recording.frames == 8


def test_who_records_is_told_of_a_failure_that_nobody_foresaw(service, http, client, begun, artifacts):
    """A file has come to stand where the blocks of the recording belong."""
    list(client.recordings.record(begun, map(frame_of, range(2))))
    header = json.loads((artifacts / "recordings" / f"{begun}.json").read_text())
    blocks = artifacts / "recording-blocks" / header["id"]
    blocks.rename(blocks.with_name("elsewhere"))
    blocks.touch()
    with pytest.raises(errors.ClientError, match="INTERNAL"):
        list(client.recordings.record(begun, map(frame_of, range(2, 4))))
    with connect(f"{service.http.replace('http', 'ws', 1)}/v1/recordings/{begun}/stream") as socket:
        socket.send(message_of(4))
        with pytest.raises(ConnectionClosedError):
            list(socket)
    assert post(http, begun, message_of(4)).status_code == 500


def test_what_a_key_may_store_holds_for_recordings(start_service, tmp_path):
    service = start_service(artifact_folder=tmp_path, max_dataset_bytes=3 * SIDE * SIDE)
    with Client(service.grpc) as client:
        client.recordings.begin("liver", SETTINGS)
        with pytest.raises(errors.UploadTooLarge):
            list(client.recordings.record("liver", map(frame_of, range(6))))


def test_others_do_not_add_to_a_recording(start_service, tmp_path):
    database = JobDatabase(tmp_path, None)
    keys = {name: KeyStore(database.engine).create(name, Role.OPERATOR, 1.0)[1] for name in ("alice", "bob")}
    database.close()
    service = start_service(artifact_folder=tmp_path)
    with Client(service.grpc, api_key=keys["alice"]) as mine, Client(service.grpc, api_key=keys["bob"]) as other:
        mine.recordings.begin("liver", SETTINGS)
        mine.recordings.begin("secret", SETTINGS, private=True)
        for ask in (
            lambda: list(other.recordings.record("liver", [frame_of(0)])),
            lambda: other.recordings.finish("liver"),
            lambda: other.recordings.begin("liver", SETTINGS),
        ):
            with pytest.raises(errors.PermissionDenied):
                ask()
        with pytest.raises(errors.DatasetNotFound):
            other.recordings.get("secret")
        assert list(mine.recordings.record("secret", [frame_of(0)]))[-1].recording.private
        list(mine.recordings.record("liver", map(frame_of, range(6))))
        assert mine.recordings.finish("liver") == mine.recordings.finish("liver")
        with pytest.raises(errors.PermissionDenied):
            other.recordings.finish("liver")


def test_a_scene_grows_while_it_is_scanned_and_outlives_killed_workers(client, http, begun, artifacts, tmp_path):
    """Three kills on the way: twice the job's process, once the worker; then it ends as a training does."""
    job = client.jobs.submit(LiveJob(recording=begun, scene=f"{begun}-live", version_every_s=0.1, device="cpu"))
    worker = RunningWorker(artifacts, None, "one", tmp_path / "worker.log", {})

    def version():
        return http.get(f"/v1/scenes/{begun}-live/file").headers.get("etag")

    def frames_done():
        return client.jobs.get(job.id).progress.frames_done or 0

    try:
        first = None
        for sweep in range(3):  # a later version is served only where it is no worse, which it need not be
            numbers = range(10 * sweep, 10 * sweep + 10)
            list(client.recordings.record(begun, map(frame_of, numbers)))
            wait_until(lambda: version() is not None and frames_done() >= 10 * (sweep + 1))  # noqa: B023
            first = first or version()
            wait_until(lambda: list(artifacts.rglob("run/live.safetensors")))
            if sweep == 2:
                worker.kill()
                worker = RunningWorker(artifacts, None, "one", tmp_path / "worker.log", {})
            else:
                os.kill(worker.job_process(), signal.SIGKILL)
        client.recordings.finish(begun)
        ended = client.jobs.wait(job.id)
        assert ended.state.value == "succeeded", client.jobs.log(job.id)
        assert "going on from a checkpoint" in client.jobs.log(job.id)
        assert version() != first
        shown = http.get(f"/v1/scenes/{begun}-live").json()
        assert shown["metrics"]["psnr_db"] > 25.0
        assert shown["confidence"] is not None
    finally:
        worker.kill()
