"""The gRPC services that keep things: scenes, data sets, jobs, workers, registrations, and who the caller is.

`CALLS` says of each method with one message either way what it asks of the service's parts; its answer becomes the
message by the codec. `STREAMS` has the methods that read or write several messages.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import replace
from typing import Any, TypeAlias

import grpc
import numpy as np

from ultragray.contract import under
from ultragray.datasets.source import UPLOAD_OPTIONS
from ultragray.errors import InvalidArgument, InvalidPose
from ultragray.geometry.registration import Registration, rows
from ultragray_proto.codec import to_message
from ultragray_proto.v1 import datasets_pb2, geometry_pb2, jobs_pb2, recordings_pb2
from ultragray_service.access.audit import DEFAULT_ENTRIES, DEFAULT_HOURS, audit_entries
from ultragray_service.access.principals import Me, me
from ultragray_service.core.editing import EditTarget, LabelTarget, RecipeTarget
from ultragray_service.core.jobs import DEFAULT_LOG_BYTES, MAX_LOG_BYTES, estimate
from ultragray_service.core.recordings import IncomingFrame, RecordingAnswer, RefusedFrame, record
from ultragray_service.core.registrations import NamedRegistration
from ultragray_service.core.scenes import DEFAULT_PAGE_SIZE
from ultragray_service.core.uploads import DatasetUpload
from ultragray_service.rpc.messages import OfProbe, job_message, read, read_pose, read_specification, read_word
from ultragray_service.service import Service
from ultragray_workers.datasets.recording import RecordingSettings
from ultragray_workers.errors import Draining
from ultragray_workers.jobs.store import JobStore
from ultragray_workers.jobs.workers import Wanted

Context: TypeAlias = grpc.aio.ServicerContext
Call: TypeAlias = Callable[[Service, Any], Awaitable[Any]]  # with the request; to a dataclass, a message or its fields
Stream: TypeAlias = Callable[[Service, Any, Context], Awaitable[Any]]

_CHUNK_BYTES = 2**20
_LOOK_AROUND_S = 15.0  # how long a watch waits for news at a time
_LINKS = ("base_to_scene", "probe_to_flange")


def _size(request: Any) -> int:
    return request.page_size or DEFAULT_PAGE_SIZE


async def _contact_sheet(service: Service, request: Any) -> Mapping[str, Any]:
    return {"png": await service.datasets.contact_sheet(request.dataset)}


async def _delete_dataset(service: Service, request: Any) -> Mapping[str, Any]:
    await service.delete_dataset(request.dataset)
    return {"dataset": request.dataset}


async def _begin_recording(service: Service, request: Any) -> Any:
    service.life.require_serving()
    with under("settings"):
        settings = read(request.settings, RecordingSettings)
    return await service.recordings.begin(request.dataset, settings, private=request.private)


async def _finish_recording(service: Service, request: Any) -> datasets_pb2.Dataset:
    service.life.require_serving()
    record = await service.recordings.finish(request.dataset)
    return to_message(service.datasets.with_owner(record), datasets_pb2.Dataset)


async def _delete_recording(service: Service, request: Any) -> Mapping[str, Any]:
    await service.recordings.delete(request.dataset)
    return {"dataset": request.dataset}


async def _submit_job(service: Service, request: Any) -> Mapping[str, Any]:
    service.life.require_serving()
    specification, field = await asyncio.to_thread(read_specification, request)  # of many poses
    job, is_new = await service.jobs.submit(
        specification,
        field=field,
        request_id=request.request_id or None,
        priority=request.priority,
        private=request.private,
    )
    return {"job": job_message(job), "created": is_new}


async def _estimate_job(service: Service, request: Any) -> jobs_pb2.JobEstimate:
    service.life.require_serving()
    specification, field = await asyncio.to_thread(read_specification, request)
    job_estimate = await estimate(service.rendering, specification, field=field)
    poses = [geometry_pb2.Pose(matrix=geometry_pb2.Matrix(values=pose)) for pose in job_estimate.poses]
    return to_message(replace(job_estimate, poses=[]), jobs_pb2.JobEstimate, poses=poses)


async def _list_jobs(service: Service, request: Any) -> Mapping[str, Any]:
    state, kind = read_word(request, "state"), read_word(request, "kind")
    page = await service.jobs.page(state=state, kind=kind, page_size=_size(request), page_token=request.page_token)
    return {"jobs": map(job_message, page.jobs), "next_page_token": page.next_page_token}


async def _retry_job(service: Service, request: Any) -> jobs_pb2.Job:
    service.life.require_serving()
    job, _ = await service.jobs.retry(request.job)
    return job_message(job)


async def _delete_job(service: Service, request: Any) -> Mapping[str, Any]:
    await service.delete_job(request.job)
    return {"job": request.job}


def _job(question: Callable[[JobStore, str], Any]) -> Call:
    async def call(service: Service, request: Any) -> jobs_pb2.Job:
        return job_message(await service.jobs.do(question, request.job))

    return call


async def _job_log(service: Service, request: Any) -> Mapping[str, Any]:
    max_bytes = request.max_bytes or DEFAULT_LOG_BYTES
    if not 1 <= max_bytes <= MAX_LOG_BYTES:
        raise InvalidArgument(f"max_bytes must be from 1 to {MAX_LOG_BYTES}, got {max_bytes}", field="max_bytes")
    return {"log": await service.jobs.do(JobStore.log_tail, request.job, max_bytes)}


def _want(wanted: Wanted) -> Call:
    return lambda service, request: service.jobs.do(JobStore.want, request.worker, wanted)


async def _put_registration(service: Service, request: Any) -> NamedRegistration:
    content = request.content
    with under("content"):
        if not content.HasField("base_to_scene"):
            raise InvalidArgument("base_to_scene is required", field="base_to_scene")
        links = {name: _rows(getattr(content, name), name) for name in _LINKS if content.HasField(name)}
        registration: Registration = read(content, Registration, **links)
    return await service.registrations.put(request.registration, content.scene, registration)


def _rows(matrix: geometry_pb2.Matrix, field: str) -> object:
    if len(matrix.values) != 16:
        raise InvalidPose(f"{field} must hold 16 numbers, row by row, got {len(matrix.values)}", field=field)
    return rows(np.reshape(matrix.values, (4, 4)))


async def _delete_registration(service: Service, request: Any) -> Mapping[str, Any]:
    await service.registrations.delete(request.registration)
    return {}


async def _who_am_i(service: Service, request: Any) -> Me:
    return me(service.guard.asks)


async def _label_scene(service: Service, request: Any) -> Any:
    target: LabelTarget = read(request, LabelTarget)
    whose = read(request, OfProbe)
    if request.label_map:
        if request.frames:
            raise InvalidArgument("either frames or label_map must be given, not both", field="label_map")
        return await service.edits.label_by_map(request.scene, target, request.label_map, whose.registration)
    frames = [
        (read_pose(frame.pose, f"frames[{index}].pose"), frame.labels) for index, frame in enumerate(request.frames)
    ]
    return await service.edits.label_by_frames(request.scene, target, frames, whose.probe, whose.registration)


CALLS: Mapping[str, Call] = {
    "SceneService.ListScenes": lambda service, request: service.scenes.page(_size(request), request.page_token),
    "SceneService.GetScene": lambda service, request: service.scenes.get(request.scene),
    "SceneService.LoadScene": lambda service, request: service.scenes.load(request.scene),
    "SceneService.LabelScene": _label_scene,
    "SceneService.EditScene": lambda service, request: service.edits.edit(request.scene, read(request, EditTarget)),
    "SceneService.MakeScene": lambda service, request: service.edits.make(read(request, RecipeTarget)),
    "SceneService.UnloadScene": lambda service, request: service.scenes.unload(request.scene),
    "DatasetService.ListDatasets": lambda service, request: service.datasets.page(_size(request), request.page_token),
    "DatasetService.GetDataset": lambda service, request: service.datasets.get(request.dataset),
    "DatasetService.GetContactSheet": _contact_sheet,
    "DatasetService.DeleteDataset": _delete_dataset,
    "RecordingService.BeginRecording": _begin_recording,
    "RecordingService.GetRecording": lambda service, request: service.recordings.get(request.dataset),
    "RecordingService.FinishRecording": _finish_recording,
    "RecordingService.DeleteRecording": _delete_recording,
    "JobService.SubmitJob": _submit_job,
    "JobService.EstimateJob": _estimate_job,
    "JobService.ListJobs": _list_jobs,
    "JobService.GetJob": _job(JobStore.get),
    "JobService.CancelJob": _job(JobStore.cancel),
    "JobService.RetryJob": _retry_job,
    "JobService.DeleteJob": _delete_job,
    "JobService.GetJobLog": _job_log,
    "WorkerService.ListWorkers": lambda service, request: service.jobs.workers(),
    "WorkerService.PauseWorker": _want(Wanted.PAUSE),
    "WorkerService.DrainWorker": _want(Wanted.DRAIN),
    "WorkerService.ResumeWorker": _want(Wanted.WORK),
    "RegistrationService.ListRegistrations": lambda service, request: service.registrations.page(
        _size(request), request.page_token
    ),
    "RegistrationService.GetRegistration": lambda service, request: service.registrations.get(request.registration),
    "RegistrationService.PutRegistration": _put_registration,
    "RegistrationService.DeleteRegistration": _delete_registration,
    "AccessService.WhoAmI": _who_am_i,
    "AccessService.ListAuditEntries": lambda service, request: audit_entries(
        service.jobs.database.engine,
        since_hours=request.since_hours or DEFAULT_HOURS,
        who=request.who or None,
        what=request.what or None,
        limit=request.limit or DEFAULT_ENTRIES,
    ),
}


async def _upload_dataset(service: Service, requests: Any, context: Context) -> datasets_pb2.UploadDatasetResponse:
    service.life.require_serving()
    first = await context.read()
    if first is grpc.aio.EOF or first.WhichOneof("part") != "header":
        raise InvalidArgument("the first message must hold the header", field="header")
    header = first.header
    options = {name: value for name in UPLOAD_OPTIONS if (value := getattr(header.options, name))}
    async with service.uploads.receive(header.dataset, options, private=header.private) as upload:
        if header.archive:
            await upload.begin_archive()
        await _receive(context, upload, archive=header.archive)
        record, is_new = await upload.finish()
    dataset = to_message(service.datasets.with_owner(record), datasets_pb2.Dataset)
    return datasets_pb2.UploadDatasetResponse(dataset=dataset, created=is_new)


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


async def _record_frames(service: Service, requests: Any, context: Context) -> None:
    service.life.require_serving()
    first = await context.read()
    if first is grpc.aio.EOF or first.WhichOneof("part") != "dataset":
        raise InvalidArgument("the first message must name the recording", field="dataset")

    async def receive() -> IncomingFrame | RefusedFrame | None:
        if (message := await context.read()) is grpc.aio.EOF:
            return None
        frame = message.frame
        number = frame.number if frame.HasField("number") else None
        try:
            pose = read_pose(frame.pose, "pose")
        except InvalidArgument as error:
            return RefusedFrame(number, error)
        time_s = frame.time_s if frame.HasField("time_s") else None
        return IncomingFrame(pose=pose, image=frame.image, number=number, time_s=time_s)

    async def send(answer: RecordingAnswer) -> None:
        await context.write(to_message(answer, recordings_pb2.RecordFramesResponse))

    with service.limits.stream():
        async with service.recordings.stream(first.dataset) as stream:
            await record(stream, receive, send, service.life.draining)


async def _download_artifact(service: Service, request: Any, context: Context) -> None:
    artifact = await service.jobs.do(JobStore.artifact, request.job, request.name)
    length, offset = artifact.stored.bytes, request.offset
    if not 0 <= offset <= length:
        raise InvalidArgument(f"offset must be from 0 to {length}, got {offset}", field="offset")
    while True:
        data = await asyncio.to_thread(artifact.read, offset, _CHUNK_BYTES)
        await context.write(jobs_pb2.ArtifactChunk(data=data, file_bytes=length))
        offset += len(data)
        if not data or offset >= length:
            return


async def _watch_job(service: Service, request: Any, context: Context) -> None:
    service.life.require_serving()
    watch = await service.jobs.hub.watch(request.job)
    while (change := await watch.next(_LOOK_AROUND_S)) is not None:
        if change.job is not None or change.log:
            job = None if change.job is None else job_message(change.job)
            await context.write(jobs_pb2.JobEvent(job=job, log=change.log))
    if not watch.finished:
        raise Draining("the service is stopping; watch the job again when it is back")


STREAMS: Mapping[str, Stream] = {
    "DatasetService.UploadDataset": _upload_dataset,
    "RecordingService.RecordFrames": _record_frames,
    "JobService.DownloadArtifact": _download_artifact,
    "JobService.WatchJob": _watch_job,
}
