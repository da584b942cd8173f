# Generated from aio/jobs.py by client/generate.py; change that file.
"""The jobs of a service."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from ultragray_client.conversations import downloaded
from ultragray_client.records import Job, JobEvent, JobFilter, JobState, Watch, job_from_message, submission
from ultragray_proto.v1 import jobs_pb2, jobs_pb2_grpc

from ..contract import Specification
from ..messages import message_of
from .connection import Connection
from .transport import run_blocking


class Jobs:
    """`client.jobs`. All raise ClientError; an id that does not exist is JobNotFound.

    A submission has a `request_id`, one of its own unless one is given: the same id with the same job gives the job
    that is there, with another one RequestIdConflict. A `priority` is from -1000 to 1000, higher ones go first. Others
    see neither a `private` job nor the scene that it makes.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._calls = jobs_pb2_grpc.JobServiceStub(connection.channel)

    def submit(
        self,
        specification: Specification,
        *,
        request_id: str | None = None,
        priority: int = 0,
        private: bool = False,
        timeout_s: float | None = None,
    ) -> Job:
        """Puts a job into the queue: `TrainJob(dataset="liver", scene="liver")` makes a scene that is served,
        `RenderJob(scene="demo", sampler=FanSampler(tilt_deg=10, step_deg=2))` an archive of frames.

        Raises DatasetNotFound, SceneNotFound, RegistrationNotFound, SceneExists, JobQueueFull, ExtraMissing,
        StorageFull, LowConfidence and other kinds of InvalidArgument.
        """
        request = submission(specification, request_id, priority, private)
        return job_from_message((self._connection.answer(self._calls.SubmitJob, request, timeout_s)).job)

    def list(
        self,
        *,
        state: JobState | str | None = None,
        kind: str | None = None,
        limit: int | None = None,
        timeout_s: float | None = None,
    ) -> tuple[Job, ...]:
        """The newest jobs first, at most `limit`; None: all that the service keeps."""
        request = message_of(JobFilter(state, kind), jobs_pb2.ListJobsRequest)
        jobs = self._connection.listed(self._calls.ListJobs, request, "jobs", timeout_s, limit=limit)
        return tuple(map(job_from_message, jobs))

    def get(self, job_id: str, *, timeout_s: float | None = None) -> Job:
        """One job."""
        request = jobs_pb2.GetJobRequest(job=job_id)
        return job_from_message(self._connection.answer(self._calls.GetJob, request, timeout_s))

    def watch(self, job_id: str, *, timeout_s: float | None = None) -> Iterator[JobEvent]:
        """The job at first and whenever it changed, and new lines of its log, until it is in its final state.

        Goes on where the service was restarted in the meantime. Without `timeout_s` it takes as long as the job.
        """
        return self._connection.converse(self._calls.WatchJob, Watch(job_id), timeout_s)

    def wait(self, job_id: str, *, timeout_s: float | None = None) -> Job:
        """The job in its final state, whichever that is."""
        job = None
        for event in self.watch(job_id, timeout_s=timeout_s):
            job = event.job or job
        assert job is not None
        return job

    def cancel(self, job_id: str, *, timeout_s: float | None = None) -> Job:
        """Stops a job within a second. Raises JobFinished for one that succeeded or failed."""
        request = jobs_pb2.CancelJobRequest(job=job_id)
        return job_from_message(self._connection.answer(self._calls.CancelJob, request, timeout_s))

    def retry(self, job_id: str, *, timeout_s: float | None = None) -> Job:
        """A new job in place of a failed or cancelled one; asked again, the same one. Raises JobNotFinished."""
        request = jobs_pb2.RetryJobRequest(job=job_id)
        return job_from_message(self._connection.answer(self._calls.RetryJob, request, timeout_s))

    def delete(self, job_id: str, *, timeout_s: float | None = None) -> None:
        """Removes a finished job and its files; a scene that it trained stays. Raises JobInUse."""
        request = jobs_pb2.DeleteJobRequest(job=job_id)
        self._connection.delete(self._calls.DeleteJob, request, timeout_s)

    def log(self, job_id: str, *, max_bytes: int = 65536, timeout_s: float | None = None) -> str:
        """The end of what the job's process said."""
        request = jobs_pb2.GetJobLogRequest(job=job_id, max_bytes=max_bytes)
        return str((self._connection.answer(self._calls.GetJobLog, request, timeout_s)).log)

    def download(self, job_id: str, artifact: str, path: str | Path, *, timeout_s: float | None = None) -> None:
        """Writes an artifact to the file `path`, whole or not at all; goes on where the connection broke.

        Raises ArtifactNotFound, and OSError where the file cannot be written.
        """
        with downloaded(job_id, artifact, Path(path)) as download:
            chunks = self._connection.converse(self._calls.DownloadArtifact, download, timeout_s)
            with closing(chunks):
                for chunk in chunks:
                    run_blocking(download.write, chunk)
