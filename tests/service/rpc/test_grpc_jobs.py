"""JobService against a real service without a worker: what is submitted waits."""

import threading

import grpc
import pytest

from ultragray_proto.v1 import geometry_pb2, jobs_pb2, jobs_pb2_grpc
from ultragray_service.rpc.messages import read_specification
from ultragray_workers.jobs.kinds import TrainJob

from .test_grpc_render import error_info

WAIT_S = 300.0


@pytest.fixture(scope="module")
def service(start_service, artifacts):
    return start_service(artifact_folder=artifacts, embedded_worker=False)


@pytest.fixture(scope="module")
def jobs(channel):
    return jobs_pb2_grpc.JobServiceStub(channel)


def training_poses(**changes):
    render = jobs_pb2.RenderJob(scene="demo", sampler=jobs_pb2.PoseSampler(kind="training"))
    return jobs_pb2.SubmitJobRequest(render=render, **changes)


def refusal(call):
    """Status, reason and field of a call that fails."""
    with pytest.raises(grpc.RpcError) as caught:
        call()
    info, _ = error_info(caught.value)
    return caught.value.code().name, info.reason, info.metadata["field"]


def test_a_render_job_is_estimated_and_not_submitted(jobs):
    before = len(jobs.ListJobs(jobs_pb2.ListJobsRequest()).jobs)
    asked = training_poses()
    asked.render.height = asked.render.width = 16
    found = jobs.EstimateJob(asked)
    assert (found.height, found.width, found.files) == (16, 16, 1)
    assert found.frames == len(found.poses) == 5
    assert found.bytes == found.frames * 16 * 16 * 4
    assert found.seconds > 0.0
    assert len(found.poses[0].matrix.values) == 16
    assert len(jobs.ListJobs(jobs_pb2.ListJobsRequest()).jobs) == before


@pytest.mark.parametrize(
    ("request_message", "expected"),
    [
        (jobs_pb2.SubmitJobRequest(), ("INVALID_ARGUMENT", "INVALID_ARGUMENT", "specification")),
        (
            jobs_pb2.SubmitJobRequest(train=jobs_pb2.TrainJob(dataset="gone", scene="new", settings={"stepz": 3})),
            ("INVALID_ARGUMENT", "INVALID_ARGUMENT", "train.settings.stepz"),
        ),
        (
            jobs_pb2.SubmitJobRequest(train=jobs_pb2.TrainJob(dataset="gone", scene="new")),
            ("NOT_FOUND", "DATASET_NOT_FOUND", "train.dataset"),
        ),
        (
            jobs_pb2.SubmitJobRequest(render=jobs_pb2.RenderJob(scene="demo", poses=[geometry_pb2.Pose()])),
            ("INVALID_ARGUMENT", "INVALID_POSE", "render.poses[0]"),
        ),
        (training_poses(priority=-1001), ("INVALID_ARGUMENT", "INVALID_ARGUMENT", "priority")),
    ],
)
def test_what_cannot_be_run_is_refused_by_name(jobs, request_message, expected):
    assert refusal(lambda: jobs.SubmitJob(request_message)) == expected


def test_logs_and_artifacts_that_there_are_none_of(jobs):
    job = jobs.SubmitJob(training_poses()).job.id
    assert jobs.GetJobLog(jobs_pb2.GetJobLogRequest(job=job)).log == ""
    log_request = jobs_pb2.GetJobLogRequest(job=job, max_bytes=-1)
    assert refusal(lambda: jobs.GetJobLog(log_request)) == ("INVALID_ARGUMENT", "INVALID_ARGUMENT", "max_bytes")
    for asked, expected in (
        ({"job": job, "name": "../job.json"}, ("NOT_FOUND", "ARTIFACT_NOT_FOUND", "name")),
        ({"job": "0" * 24, "name": "frames.npz"}, ("NOT_FOUND", "JOB_NOT_FOUND", "job")),
    ):
        request = jobs_pb2.DownloadArtifactRequest(**asked)
        assert refusal(lambda request=request: list(jobs.DownloadArtifact(request))) == expected


def test_a_stopping_service_tells_its_watchers_to_come_again(start_service, tmp_path):
    service = start_service(artifact_folder=tmp_path)
    with service.channel() as channel:
        jobs = jobs_pb2_grpc.JobServiceStub(channel)
        watch = jobs.WatchJob(jobs_pb2.WatchJobRequest(job=jobs.SubmitJob(training_poses()).job.id), timeout=WAIT_S)
        next(watch)
        stopper = threading.Thread(target=service.terminate)
        stopper.start()
        assert refusal(lambda: next(watch)) == ("UNAVAILABLE", "DRAINING", "")
        stopper.join(WAIT_S)
        assert service.process.returncode == 0


def test_whole_numbers_of_settings_are_integers():
    train = jobs_pb2.TrainJob(dataset="sweep", scene="new")
    given = {"steps": 250, "prune_above": 0.5, "transmittance": False, "memory_gb": None, "start": "random"}
    train.settings.update(given)
    specification, field = read_specification(jobs_pb2.SubmitJobRequest(train=train))
    assert field == "train"
    assert isinstance(specification, TrainJob)
    assert (specification.preset, specification.device) == ("fast", "auto")
    assert specification.settings == given
    assert all(type(value) is type(given[name]) for name, value in specification.settings.items())
