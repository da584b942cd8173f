"""JobService."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import grpc

from ultragray.errors import InvalidArgument
from ultragray_proto.codec import to_message
from ultragray_proto.v1 import geometry_pb2, jobs_pb2
from ultragray_service.core.jobs.estimates import estimate
from ultragray_service.core.jobs.log import DEFAULT_LOG_BYTES, MAX_LOG_BYTES
from ultragray_service.core.scenes import DEFAULT_PAGE_SIZE
from ultragray_service.rpc.messages import job_message, read_specification, read_word
from ultragray_service.service import Service
from ultragray_workers.errors import Draining
from ultragray_workers.jobs.shared.reading import opened
from ultragray_workers.jobs.store import JobStore

_CHUNK_BYTES = 2**20
_LOOK_AROUND_S = 15.0  # how long a watch waits for news at a time


class JobService:
    """The methods of ultragray.v1.JobService."""

    def __init__(self, service: Service) -> None:
        self._service = service

    async def SubmitJob(  # noqa: N802
        self, request: jobs_pb2.SubmitJobRequest, context: grpc.aio.ServicerContext
    ) -> jobs_pb2.SubmitJobResponse:
        self._service.life.require_serving()
        specification, field = await asyncio.to_thread(read_specification, request)  # of many poses
        job, is_new = await self._service.jobs.submit(
            specification,
            field=field,
            request_id=request.request_id or None,
            priority=request.priority,
            private=request.private,
        )
        return jobs_pb2.SubmitJobResponse(job=job_message(job), created=is_new)

    async def EstimateJob(  # noqa: N802
        self, request: jobs_pb2.SubmitJobRequest, context: grpc.aio.ServicerContext
    ) -> jobs_pb2.JobEstimate:
        self._service.life.require_serving()
        specification, field = await asyncio.to_thread(read_specification, request)
        found = await estimate(self._service.rendering, specification, field=field)
        poses = [geometry_pb2.Pose(matrix=geometry_pb2.Matrix(values=pose)) for pose in found.poses]
        return to_message(replace(found, poses=[]), jobs_pb2.JobEstimate, poses=poses)

    async def ListJobs(  # noqa: N802
        self, request: jobs_pb2.ListJobsRequest, context: grpc.aio.ServicerContext
    ) -> jobs_pb2.ListJobsResponse:
        page = await self._service.jobs.page(
            state=read_word(request, "state"),
            kind=read_word(request, "kind"),
            page_size=request.page_size or DEFAULT_PAGE_SIZE,
            page_token=request.page_token,
        )
        jobs = [job_message(job) for job in page.jobs]
        return jobs_pb2.ListJobsResponse(jobs=jobs, next_page_token=page.next_page_token)

    async def GetJob(  # noqa: N802
        self, request: jobs_pb2.GetJobRequest, context: grpc.aio.ServicerContext
    ) -> jobs_pb2.Job:
        return job_message(await self._service.jobs.do(JobStore.get, request.job))

    async def CancelJob(  # noqa: N802
        self, request: jobs_pb2.CancelJobRequest, context: grpc.aio.ServicerContext
    ) -> jobs_pb2.Job:
        return job_message(await self._service.jobs.do(JobStore.cancel, request.job))

    async def RetryJob(  # noqa: N802
        self, request: jobs_pb2.RetryJobRequest, context: grpc.aio.ServicerContext
    ) -> jobs_pb2.Job:
        self._service.life.require_serving()
        job, _ = await self._service.jobs.retry(request.job)
        return job_message(job)

    async def DeleteJob(  # noqa: N802
        self, request: jobs_pb2.DeleteJobRequest, context: grpc.aio.ServicerContext
    ) -> jobs_pb2.DeleteJobResponse:
        await self._service.delete_job(request.job)
        return jobs_pb2.DeleteJobResponse(job=request.job)

    async def GetJobLog(  # noqa: N802
        self, request: jobs_pb2.GetJobLogRequest, context: grpc.aio.ServicerContext
    ) -> jobs_pb2.GetJobLogResponse:
        max_bytes = request.max_bytes or DEFAULT_LOG_BYTES
        if not 1 <= max_bytes <= MAX_LOG_BYTES:
            raise InvalidArgument(f"max_bytes must be from 1 to {MAX_LOG_BYTES}, got {max_bytes}", field="max_bytes")
        return jobs_pb2.GetJobLogResponse(log=await self._service.jobs.do(JobStore.log_tail, request.job, max_bytes))

    async def DownloadArtifact(  # noqa: N802
        self, request: jobs_pb2.DownloadArtifactRequest, context: grpc.aio.ServicerContext
    ) -> None:
        found = await self._service.jobs.do(JobStore.artifact, request.job, request.name)
        with opened(found) as file:
            if not 0 <= request.offset <= file.length:
                raise InvalidArgument(f"offset must be from 0 to {file.length}, got {request.offset}", field="offset")
            offset = request.offset
            while True:
                data = await asyncio.to_thread(file.read, offset, _CHUNK_BYTES)
                await context.write(jobs_pb2.ArtifactChunk(data=data, file_bytes=file.length))
                offset += len(data)
                if not data or offset >= file.length:
                    return

    async def WatchJob(  # noqa: N802
        self, request: jobs_pb2.WatchJobRequest, context: grpc.aio.ServicerContext
    ) -> None:
        self._service.life.require_serving()
        watch = await self._service.jobs.hub.watch(request.job)
        try:
            while (change := await watch.next(_LOOK_AROUND_S)) is not None:
                if change.job is None and not change.log:
                    continue
                job = None if change.job is None else job_message(change.job)
                await context.write(jobs_pb2.JobEvent(job=job, log=change.log))
            if not watch.finished:
                raise Draining("the service is stopping; watch the job again when it is back")
        finally:
            watch.close()
