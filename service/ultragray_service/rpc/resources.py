"""The gRPC services that keep things: scenes, data sets, jobs, workers, registrations, and who the caller is."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TypeAlias

import grpc
import numpy as np

from ultragray.contract import under
from ultragray.datasets.source import UPLOAD_OPTIONS
from ultragray.errors import InvalidArgument, InvalidPose
from ultragray.geometry.registration import Registration, rows
from ultragray_proto.codec import to_message
from ultragray_proto.v1 import (
    access_pb2,
    datasets_pb2,
    geometry_pb2,
    jobs_pb2,
    registrations_pb2,
    scenes_pb2,
    workers_pb2,
)
from ultragray_service.access.principals import me
from ultragray_service.core.jobs.estimates import estimate
from ultragray_service.core.jobs.log import DEFAULT_LOG_BYTES, MAX_LOG_BYTES
from ultragray_service.core.scenes import DEFAULT_PAGE_SIZE
from ultragray_service.core.uploads import DatasetUpload
from ultragray_service.rpc.messages import job_message, read, read_specification, read_word
from ultragray_service.service import Service
from ultragray_service.views.audited import DEFAULT_ENTRIES, DEFAULT_HOURS, audit_entries
from ultragray_workers.errors import Draining
from ultragray_workers.jobs.store import JobStore
from ultragray_workers.jobs.workers import Wanted

Context: TypeAlias = grpc.aio.ServicerContext


class SceneService:
    def __init__(self, service: Service) -> None:
        self._service = service

    async def ListScenes(
        self, request: scenes_pb2.ListScenesRequest, context: Context
    ) -> scenes_pb2.ListScenesResponse:
        page = await self._service.scenes.page(request.page_size or DEFAULT_PAGE_SIZE, request.page_token)
        return to_message(page, scenes_pb2.ListScenesResponse)

    async def GetScene(self, request: scenes_pb2.GetSceneRequest, context: Context) -> scenes_pb2.Scene:
        return to_message(await self._service.scenes.get(request.scene), scenes_pb2.Scene)

    async def LoadScene(self, request: scenes_pb2.LoadSceneRequest, context: Context) -> scenes_pb2.LoadSceneResponse:
        loaded = await self._service.scenes.load(request.scene)
        return to_message(loaded, scenes_pb2.LoadSceneResponse)

    async def UnloadScene(
        self, request: scenes_pb2.UnloadSceneRequest, context: Context
    ) -> scenes_pb2.UnloadSceneResponse:
        loaded = await self._service.scenes.unload(request.scene)
        return to_message(loaded, scenes_pb2.UnloadSceneResponse)


class DatasetService:
    def __init__(self, service: Service) -> None:
        self._service = service

    async def UploadDataset(self, requests: object, context: Context) -> datasets_pb2.UploadDatasetResponse:
        self._service.life.require_serving()
        first = await context.read()
        if first is grpc.aio.EOF or first.WhichOneof("part") != "header":
            raise InvalidArgument("the first message must hold the header", field="header")
        header = first.header
        options = {name: value for name in UPLOAD_OPTIONS if (value := getattr(header.options, name))}
        async with self._service.uploads.receive(header.dataset, options, private=header.private) as upload:
            if header.archive:
                await upload.begin_archive()
            await _receive(context, upload, archive=header.archive)
            record, is_new = await upload.finish()
        told = to_message(self._service.datasets.with_owner(record), datasets_pb2.Dataset)
        return datasets_pb2.UploadDatasetResponse(dataset=told, created=is_new)

    async def ListDatasets(
        self, request: datasets_pb2.ListDatasetsRequest, context: Context
    ) -> datasets_pb2.ListDatasetsResponse:
        page_size = request.page_size or DEFAULT_PAGE_SIZE
        page = await self._service.datasets.page(page_size, request.page_token)
        return to_message(page, datasets_pb2.ListDatasetsResponse)

    async def GetDataset(self, request: datasets_pb2.GetDatasetRequest, context: Context) -> datasets_pb2.Dataset:
        return to_message(await self._service.datasets.get(request.dataset), datasets_pb2.Dataset)

    async def GetContactSheet(
        self, request: datasets_pb2.GetContactSheetRequest, context: Context
    ) -> datasets_pb2.GetContactSheetResponse:
        return datasets_pb2.GetContactSheetResponse(png=await self._service.datasets.contact_sheet(request.dataset))

    async def DeleteDataset(
        self, request: datasets_pb2.DeleteDatasetRequest, context: Context
    ) -> datasets_pb2.DeleteDatasetResponse:
        await self._service.delete_dataset(request.dataset)
        return datasets_pb2.DeleteDatasetResponse(dataset=request.dataset)


async def _receive(context: Context, upload: DatasetUpload, *, archive: bool) -> None:
    while (message := await upload.next(context.read())) is not grpc.aio.EOF:
        part = message.WhichOneof("part")
        if part == "chunk":
            await upload.write(message.chunk)
        elif part == "file" and not archive:
            await upload.begin_file(message.file)
        else:
            expected = "chunk" if archive else "file or chunk"
            raise InvalidArgument(f"a message after the header must hold {expected}, got {part or 'neither'}")


_CHUNK_BYTES = 2**20
_LOOK_AROUND_S = 15.0  # how long a watch waits for news at a time


class JobService:
    def __init__(self, service: Service) -> None:
        self._service = service

    async def SubmitJob(self, request: jobs_pb2.SubmitJobRequest, context: Context) -> jobs_pb2.SubmitJobResponse:
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

    async def EstimateJob(self, request: jobs_pb2.SubmitJobRequest, context: Context) -> jobs_pb2.JobEstimate:
        self._service.life.require_serving()
        specification, field = await asyncio.to_thread(read_specification, request)
        found = await estimate(self._service.rendering, specification, field=field)
        poses = [geometry_pb2.Pose(matrix=geometry_pb2.Matrix(values=pose)) for pose in found.poses]
        return to_message(replace(found, poses=[]), jobs_pb2.JobEstimate, poses=poses)

    async def ListJobs(self, request: jobs_pb2.ListJobsRequest, context: Context) -> jobs_pb2.ListJobsResponse:
        page = await self._service.jobs.page(
            state=read_word(request, "state"),
            kind=read_word(request, "kind"),
            page_size=request.page_size or DEFAULT_PAGE_SIZE,
            page_token=request.page_token,
        )
        jobs = [job_message(job) for job in page.jobs]
        return jobs_pb2.ListJobsResponse(jobs=jobs, next_page_token=page.next_page_token)

    async def GetJob(self, request: jobs_pb2.GetJobRequest, context: Context) -> jobs_pb2.Job:
        return job_message(await self._service.jobs.do(JobStore.get, request.job))

    async def CancelJob(self, request: jobs_pb2.CancelJobRequest, context: Context) -> jobs_pb2.Job:
        return job_message(await self._service.jobs.do(JobStore.cancel, request.job))

    async def RetryJob(self, request: jobs_pb2.RetryJobRequest, context: Context) -> jobs_pb2.Job:
        self._service.life.require_serving()
        job, _ = await self._service.jobs.retry(request.job)
        return job_message(job)

    async def DeleteJob(self, request: jobs_pb2.DeleteJobRequest, context: Context) -> jobs_pb2.DeleteJobResponse:
        await self._service.delete_job(request.job)
        return jobs_pb2.DeleteJobResponse(job=request.job)

    async def GetJobLog(self, request: jobs_pb2.GetJobLogRequest, context: Context) -> jobs_pb2.GetJobLogResponse:
        max_bytes = request.max_bytes or DEFAULT_LOG_BYTES
        if not 1 <= max_bytes <= MAX_LOG_BYTES:
            raise InvalidArgument(f"max_bytes must be from 1 to {MAX_LOG_BYTES}, got {max_bytes}", field="max_bytes")
        return jobs_pb2.GetJobLogResponse(log=await self._service.jobs.do(JobStore.log_tail, request.job, max_bytes))

    async def DownloadArtifact(self, request: jobs_pb2.DownloadArtifactRequest, context: Context) -> None:
        found = await self._service.jobs.do(JobStore.artifact, request.job, request.name)
        length, offset = found.stored.bytes, request.offset
        if not 0 <= offset <= length:
            raise InvalidArgument(f"offset must be from 0 to {length}, got {offset}", field="offset")
        while True:
            data = await asyncio.to_thread(found.read, offset, _CHUNK_BYTES)
            await context.write(jobs_pb2.ArtifactChunk(data=data, file_bytes=length))
            offset += len(data)
            if not data or offset >= length:
                return

    async def WatchJob(self, request: jobs_pb2.WatchJobRequest, context: Context) -> None:
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


class WorkerService:
    def __init__(self, service: Service) -> None:
        self._service = service

    async def ListWorkers(
        self, request: workers_pb2.ListWorkersRequest, context: Context
    ) -> workers_pb2.ListWorkersResponse:
        return to_message(await self._service.jobs.workers(), workers_pb2.ListWorkersResponse)

    async def PauseWorker(self, request: workers_pb2.PauseWorkerRequest, context: Context) -> workers_pb2.Worker:
        return await self._want(request.worker, Wanted.PAUSE)

    async def DrainWorker(self, request: workers_pb2.DrainWorkerRequest, context: Context) -> workers_pb2.Worker:
        return await self._want(request.worker, Wanted.DRAIN)

    async def ResumeWorker(self, request: workers_pb2.ResumeWorkerRequest, context: Context) -> workers_pb2.Worker:
        return await self._want(request.worker, Wanted.WORK)

    async def _want(self, worker: str, wanted: Wanted) -> workers_pb2.Worker:
        return to_message(await self._service.jobs.do(JobStore.want, worker, wanted), workers_pb2.Worker)


_LINKS = ("base_to_scene", "probe_to_flange")


class RegistrationService:
    def __init__(self, service: Service) -> None:
        self._service = service

    async def ListRegistrations(
        self, request: registrations_pb2.ListRegistrationsRequest, context: Context
    ) -> registrations_pb2.ListRegistrationsResponse:
        page_size = request.page_size or DEFAULT_PAGE_SIZE
        page = await self._service.registrations.page(page_size, request.page_token)
        return to_message(page, registrations_pb2.ListRegistrationsResponse)

    async def GetRegistration(
        self, request: registrations_pb2.GetRegistrationRequest, context: Context
    ) -> registrations_pb2.Registration:
        return to_message(await self._service.registrations.get(request.registration), registrations_pb2.Registration)

    async def PutRegistration(
        self, request: registrations_pb2.PutRegistrationRequest, context: Context
    ) -> registrations_pb2.Registration:
        content = request.content
        with under("content"):
            if not content.HasField("base_to_scene"):
                raise InvalidArgument("base_to_scene is required", field="base_to_scene")
            links = {name: _rows(getattr(content, name), name) for name in _LINKS if content.HasField(name)}
            registration: Registration = read(content, Registration, **links)
        kept = await self._service.registrations.put(request.registration, content.scene, registration)
        return to_message(kept, registrations_pb2.Registration)

    async def DeleteRegistration(
        self, request: registrations_pb2.DeleteRegistrationRequest, context: Context
    ) -> registrations_pb2.DeleteRegistrationResponse:
        await self._service.registrations.delete(request.registration)
        return registrations_pb2.DeleteRegistrationResponse()


def _rows(matrix: geometry_pb2.Matrix, field: str) -> object:
    if len(matrix.values) != 16:
        raise InvalidPose(f"{field} must hold 16 numbers, row by row, got {len(matrix.values)}", field=field)
    return rows(np.reshape(matrix.values, (4, 4)))


class AccessService:
    def __init__(self, service: Service) -> None:
        self._service = service

    async def WhoAmI(self, request: access_pb2.WhoAmIRequest, context: Context) -> access_pb2.WhoAmIResponse:
        return to_message(me(self._service.guard.asks), access_pb2.WhoAmIResponse)

    async def ListAuditEntries(
        self, request: access_pb2.ListAuditEntriesRequest, context: Context
    ) -> access_pb2.ListAuditEntriesResponse:
        entries = await audit_entries(
            self._service.jobs.database.engine,
            since_hours=request.since_hours or DEFAULT_HOURS,
            who=request.who or None,
            what=request.what or None,
            limit=request.limit or DEFAULT_ENTRIES,
        )
        return to_message(entries, access_pb2.ListAuditEntriesResponse)
