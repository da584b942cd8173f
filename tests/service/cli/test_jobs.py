"""`ultragray jobs`, `workers` and `worker` against a real service with its worker."""

import json
import os
import signal
import subprocess
import sys
import tarfile

import numpy as np
import pytest
from typer.testing import CliRunner

from ultragray.files import file_sha256
from ultragray_service.cli.app import app
from ultragray_service.cli.jobs import JOB_CANCELLED, JOB_FAILED, results
from ultragray_workers.jobs.store import JobStore
from ultragray_workers.jobs.workers import WorkerState

from ...waiting import wait_until
from ...workers.jobs.conftest import store_dataset
from ..conftest import ROOT, SOURCE_FOLDERS

WAIT_S = 300.0
KEY = "0123456789abcdef-jobs"


def run(service, *arguments, key=KEY):
    environment = {"ULTRAGRAY_ADDRESS": service.http, "ULTRAGRAY_API_KEY": key}
    return CliRunner().invoke(app, ["jobs", *map(str, arguments)], env=environment)


def done(service, *arguments):
    result = run(service, *arguments)
    assert result.exit_code == 0, result.output
    return result.stdout


@pytest.fixture(scope="module")
def service(start_service, artifacts):
    """A service with a worker, which holds the dataset `tiny`."""
    store_dataset(artifacts, "tiny")
    return start_service(artifact_folder=artifacts, embedded_worker=True, training_threads=1, api_keys=KEY)


def test_a_job_that_no_worker_can_take_is_submitted_with_a_warning(service):
    asked = ("--min-memory-gb", "900000", "--require", "site=lab1", "--require", "rack=4")
    result = run(service, "submit", "render", "demo", "--sampler", "training", *asked)
    assert result.exit_code == 0, result.output
    job = result.stdout.strip()
    told = json.loads(done(service, "show", job, "--json"))
    assert told["specification"]["worker_labels"] == {"site": "lab1", "rack": "4"}
    wanted = "a worker with a device of at least 900000 GB and the labels rack=4, site=lab1"
    assert " ".join(result.stderr.split()).startswith(f"warning: {job} waits for {wanted}")
    assert told["progress"]["waits_for"].startswith(wanted)
    done(service, "cancel", job)


def test_poses_of_a_file_become_an_archive(service, http, tmp_path):
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 1, 3] = (0.5, 1.5, 2.5)
    np.save(tmp_path / "poses.npy", poses)
    arguments = ("--poses", tmp_path / "poses.npy", "--height", 24, "--width", 16, "--format", "tar", "--wait")
    job = done(service, "submit", "render", "demo", *arguments).splitlines()[0]
    *examples, name = http.get(f"/v1/jobs/{job}").json()["artifacts"]
    assert examples == [f"example_{place:05d}.png" for place in range(3)]
    done(service, "download", job, name, "-o", tmp_path / name)
    with tarfile.open(tmp_path / name) as archive:
        pictures = [entry for entry in archive.getnames() if entry.endswith(".png")]
    assert pictures == [f"{number:06d}.bmode.png" for number in range(3)]
    assert http.get(f"/v1/jobs/{job}/artifacts/{name}").headers["content-type"] == "application/x-tar"
    listed = json.loads(done(service, "list", "--kind", "render", "--json"))
    assert job in {entry["id"] for entry in listed}
    assert job in done(service, "list", "--state", "succeeded")


def test_shards_are_downloaded_by_one_name_those_that_are_missing(service, http, tmp_path):
    sampler = ("--sampler", "around", "--count", 50, "--shard-frames", 20, "--height", 24, "--width", 16)
    job = done(service, "submit", "render", "demo", *sampler, "--wait").splitlines()[0]
    told = http.get(f"/v1/jobs/{job}").json()
    files = "frames-{000000..000002}.tar"
    assert told["artifacts"] == ["manifest.json", files]
    assert (told["specification"]["format"], told["progress"]["frames_done"]) == ("tar", 50)
    assert "wrote 3 files" in done(service, "download", job, files, "-o", tmp_path / "frames")
    (tmp_path / "frames" / "frames-000001.tar").unlink()
    again = json.loads(done(service, "download", job, files, "-o", tmp_path / "frames", "--json"))
    assert (again["files"], again["there_before"]) == (1, 2)
    for shard in http.get(f"/v1/jobs/{job}/artifacts/manifest.json").json()["shards"]:
        assert file_sha256(tmp_path / "frames" / shard["file"]) == shard["sha256"]
    assert http.get(f"/v1/jobs/{job}/artifacts/frames-000003.tar").status_code == 404
    assert http.get(f"/v1/jobs/{job}/artifacts/{files}").status_code == 404


def test_a_job_that_fails_says_why_by_its_exit_code(service, http):
    result = run(service, "submit", "train", "tiny", "--scene", "never", "--set", "memory_gb=0.001", "--wait")
    assert result.exit_code == JOB_FAILED, result.output
    assert "memory_gb allows" in result.stderr.splitlines()[-1]
    assert result.stderr.splitlines()[-1].startswith("error: ")
    assert "Traceback" not in result.output


def test_a_cancelled_job_has_its_own_exit_code_and_can_be_retried(service, http):
    job = done(service, "submit", "train", "tiny", "--scene", "long", "--set", "steps=1000000").strip()
    used = http.delete("/v1/datasets/tiny")
    assert (used.status_code, used.json()["reason"]) == (409, "DATASET_IN_USE")
    assert done(service, "cancel", job) == f"{job} cancelled\n"
    assert run(service, "watch", job).exit_code == JOB_CANCELLED
    again = done(service, "retry", job).strip()
    assert http.get(f"/v1/jobs/{again}").json()["retry_of"] == job
    done(service, "cancel", again)
    assert done(service, "delete", again) == f"{again} deleted\n"
    assert "there is no job" in run(service, "delete", again).stderr


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("watch", "0" * 24), "there is no job"),
        (("list", "--api-key", "x" * 16), "API key"),
        (("submit", "render", "demo", "--format", "dicom", "--outputs", "echo"), "bmode alone in format dicom"),
        (("submit", "render", "gone"), "no scene"),
        (("submit", "train", "tiny", "--scene", "new", "--set", "stepz=3"), "no setting stepz; it has steps, "),
    ],
)
def test_mistakes_give_one_line(service, arguments, told):
    result = run(service, *arguments)
    assert result.exit_code == 2, result.output
    assert result.stderr.startswith("error: ")
    assert told in result.stderr
    assert result.stderr.count("\n") == 1


def test_a_watch_outlives_a_restart_of_the_service(start_service, tmp_path):
    settings = {"artifact_folder": tmp_path / "artifacts", "embedded_worker": False, "api_keys": KEY}
    first = start_service(**settings)
    job = done(first, "submit", "render", "demo").strip()
    path = os.pathsep.join(str(ROOT / folder) for folder in SOURCE_FOLDERS)
    watching = subprocess.Popen(
        [sys.executable, "-c", "from ultragray_service.cli.app import app; app()", "jobs", "watch", job],
        env={**os.environ, "PYTHONPATH": path, "ULTRAGRAY_ADDRESS": first.http, "ULTRAGRAY_API_KEY": KEY},
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert watching.stderr.readline() == f"{job} queued waits for a worker: none is running\n"
        first.process.kill()
        first.process.wait(WAIT_S)
        second = start_service(**settings, http_port=first.http.rpartition(":")[2])
        assert done(second, "cancel", job) == f"{job} cancelled\n"
        assert watching.wait(WAIT_S) == JOB_CANCELLED
    finally:
        watching.kill()
        watching.communicate()


def test_many_metrics_stand_in_lines_of_their_own():
    few = {"metrics": {"psnr_db": 28.125}, "artifacts": ["scene.ugr"]}
    assert results(few) == "; psnr_db 28.12; artifacts: scene.ugr"
    many = {"metrics": {f"method_{number}_gms": 0.5 for number in range(7)}, "artifacts": ["comparison.html"]}
    first, *lines = results(many).split("\n")
    assert first == "; artifacts: comparison.html"
    assert lines == [f"  method_{number}_gms 0.5" for number in range(7)]


def test_commands_list_pause_drain_and_resume(service):
    def asked(*arguments):
        environment = {"ULTRAGRAY_ADDRESS": service.http, "ULTRAGRAY_API_KEY": KEY}
        return CliRunner().invoke(app, ["workers", *arguments], env=environment)

    def told(*arguments):
        result = asked(*arguments)
        assert result.exit_code == 0, result.output
        return result.stdout

    def states():
        return {worker["name"]: worker["state"] for worker in json.loads(told("list", "--json"))}

    assert wait_until(lambda: "idle" in states().values())
    (name,) = states()
    for wish, state in (("pause", "paused"), ("drain", "drained"), ("resume", "idle")):
        assert told(wish, name) == f"{name} {state}\n"
        assert states() == {name: state}
    assert told("list").splitlines()[0].split()[:3] == ["name", "state", "job"]
    absent = asked("pause", "absent")
    assert (absent.exit_code, "absent" in absent.stderr) == (2, True)


WORKER = [sys.executable, "-c", "from ultragray_service.cli.app import app; app()", "worker"]


@pytest.mark.slow
def test_worker_command_takes_jobs_until_it_is_stopped(tmp_path):
    store = JobStore(tmp_path / "artifacts", None)
    options = ["--artifact-folder", str(tmp_path / "artifacts"), "--name", "mine", "--device", "cpu", "--threads", "1"]
    process = subprocess.Popen([*WORKER, *options], stderr=subprocess.PIPE, text=True)
    try:
        (worker,) = wait_until(store.workers)
        assert (worker.name, worker.pid, worker.device, worker.state) == ("mine", process.pid, "cpu", WorkerState.IDLE)
    finally:
        process.send_signal(signal.SIGTERM)
        _, told = process.communicate(timeout=300)
    assert process.returncode == 0, told
    messages = [json.loads(line)["message"] for line in told.splitlines()]
    assert "worker mine takes jobs" in messages
    assert messages[-1] == "worker mine stopped"
    store.close()
