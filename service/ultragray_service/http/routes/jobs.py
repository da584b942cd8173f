"""Jobs: submitted, watched, their files, and the workers that do them."""

from __future__ import annotations

import asyncio
import hashlib
import re
from collections.abc import AsyncIterator
from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from typing import Annotated, Any, Literal
from urllib.parse import quote

from fastapi import APIRouter, Header, Path, Query
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response, StreamingResponse

from ultragray.contract import under
from ultragray.errors import InvalidArgument
from ultragray_service.core.jobs import (
    DEFAULT_LOG_BYTES,
    MAX_LOG_BYTES,
    JobChange,
    JobEstimate,
    JobPage,
    JobWatch,
    WorkerList,
    estimate,
)
from ultragray_service.core.scenes import DEFAULT_PAGE_SIZE, MAX_PAGE_SIZE
from ultragray_service.http.accept import NPZ, PNG
from ultragray_service.http.bodies import SPECIFICATION, JobBody, adapter_of, body_schema, read_json_body
from ultragray_service.http.dependencies import (
    JOB_EXAMPLES,
    NOT_MODIFIED,
    Answers,
    PageToken,
    ServiceDep,
    answer,
    is_known,
    problems,
)
from ultragray_service.views.prepared import TrainingCurve
from ultragray_workers.jobs.files import Artifact
from ultragray_workers.jobs.kinds import KINDS, Specification
from ultragray_workers.jobs.kinds.base import from_dict
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.record import Job
from ultragray_workers.jobs.store import JobStore
from ultragray_workers.jobs.workers import Wanted, Worker

EVENTS_TYPE = "text/event-stream"
KEEP_ALIVE_S = 15.0
RETRY_MS = 1000  # after which a client whose stream broke asks again
_ID = re.compile(r"([0-9]{1,15})-([0-9a-f]{16})?")
_DIGEST_BYTES = 8


@dataclass(frozen=True)
class LastEvent:
    """What a client knows after an event: the log up to a byte, and the job by its digest. None: nothing."""

    log_offset: int | None = None
    digest: str | None = None

    def __str__(self) -> str:
        return f"{self.log_offset or 0}-{self.digest or ''}"

    @classmethod
    def read(cls, event_id: str) -> LastEvent:
        if (match := _ID.fullmatch(event_id)) is None:
            return cls()
        return cls(int(match[1]), match[2])


async def _events(watch: JobWatch, last: LastEvent) -> AsyncIterator[bytes]:
    yield f"retry: {RETRY_MS}\n\n".encode()
    while (change := await watch.next(KEEP_ALIVE_S)) is not None:
        text, last = _written(change, last)
        yield text.encode() or b": still here\n\n"


def _written(change: JobChange, last: LastEvent) -> tuple[str, LastEvent]:
    text = ""
    if change.log:
        last = replace(last, log_offset=change.log_offset)
        text += _event("log", last, change.log)
    if change.job is not None:
        job = adapter_of(Job).dump_json(change.job)
        digest = hashlib.blake2b(job, digest_size=_DIGEST_BYTES).hexdigest()
        if digest != last.digest:
            last = LastEvent(change.log_offset, digest)
            text += _event("progress", last, job.decode())
    return text, last


def _event(name: str, event_id: LastEvent, data: str) -> str:
    whole = data.replace("\r\n", "\n").replace("\r", "\n").removesuffix("\n")
    lines = "".join(f"data: {line}\n" for line in whole.split("\n"))
    return f"event: {name}\nid: {event_id}\n{lines}\n"


router = APIRouter(prefix="/v1/jobs", tags=["jobs"])

MEDIA_TYPES = {
    ".dcm": "application/dicom",
    ".h5": "application/x-hdf5",
    ".html": "text/html; charset=utf-8",
    ".json": "application/json",
    ".jsonl": "application/jsonl",
    ".npz": NPZ,
    ".png": PNG,
    ".tar": "application/x-tar",
    ".tex": "application/x-tex",
    ".zip": "application/zip",
}
_ANY_FILE = "application/octet-stream"

JobId = Annotated[str, Path(description="Id of the job.")]
_AnyState: Any = Literal.__getitem__(("", *(state.value for state in JobState)))
_AnyKind: Any = Literal.__getitem__(("", *KINDS))
StateFilter = Annotated[_AnyState, Query(description="Only jobs in this state; empty: all.")]
KindFilter = Annotated[_AnyKind, Query(description="Only jobs of this kind; empty: all.")]
PageSize = Annotated[int, Query(ge=1, le=MAX_PAGE_SIZE, description="Jobs on one page.")]
LogBytes = Annotated[int, Query(ge=1, le=MAX_LOG_BYTES, description="How much of the log's end is given.")]
LastEventId = Annotated[str, Header(alias="Last-Event-ID", description="Id of the last event of an earlier stream.")]

_SUBMIT = body_schema(JobBody, JOB_EXAMPLES)
_SAME_JOB: Answers = {200: {"model": Job, "description": "The job that this request_id made before."}}
_SAME_RETRY: Answers = {200: {"model": Job, "description": "The job that an earlier call made."}}
_LOG: Answers = {200: {"description": "The end of the log.", "content": {"text/plain": {}}}}
_FILE = answer("The file.", *MEDIA_TYPES.values(), _ANY_FILE)
_PREVIEW = answer("8-bit grey: the frame as it was recorded, and to its right as it is rendered.", PNG)
_EVENTS: Answers = {
    200: {
        "description": "Server-sent events: `progress` with the job (Job) at first and whenever it changed, at most "
        "twice a second; `log` with new lines. The stream ends after the job's final state.",
        "content": {EVENTS_TYPE: {"schema": {"type": "string"}}},
    }
}


@router.post(
    "",
    status_code=201,
    response_model=Job,
    openapi_extra=_SUBMIT,
    responses=_SAME_JOB | problems(401, 403, 404, 409, 413, 415, 422, 429, 503, 507),
)
async def submit_job(request: Request, response: Response, service: ServiceDep) -> Job:
    """Puts a job into the queue. The same request_id with the same body gives the same job, whatever its state."""
    service.life.require_serving()
    body = await read_json_body(request, JobBody, SPECIFICATION)
    job, is_new = await service.jobs.submit(
        await _specification(body),
        field=SPECIFICATION.key,
        request_id=body.request_id,
        priority=body.priority,
        private=body.private,
    )
    response.status_code = 201 if is_new else 200
    return job


@router.post(
    ":estimate",
    response_model=JobEstimate,
    openapi_extra=_SUBMIT,
    responses=problems(401, 404, 413, 415, 422, 429, 503),
)
async def estimate_job(request: Request, service: ServiceDep) -> JobEstimate:
    """What a render job would make, and how long that may take: a frame of it is rendered. Nothing is submitted."""
    service.life.require_serving()
    body = await read_json_body(request, JobBody, SPECIFICATION)
    return await estimate(service.rendering, await _specification(body), field=SPECIFICATION.key)


@router.get("", responses=problems(401, 422, 503))
async def list_jobs(
    service: ServiceDep,
    state: StateFilter = "",
    kind: KindFilter = "",
    page_size: PageSize = DEFAULT_PAGE_SIZE,
    page_token: PageToken = "",
) -> JobPage:
    """The jobs, newest first."""
    return await service.jobs.page(state=state, kind=kind, page_size=page_size, page_token=page_token)


async def _specification(body: JobBody) -> Specification:
    with under(SPECIFICATION.key):
        if "kind" in body.specification:
            raise InvalidArgument("kind stands beside the specification, not in it", field="kind")
        # in a thread: there may be many poses
        return await asyncio.to_thread(from_dict, {"kind": body.kind, **body.specification})


@router.get("/{job}", responses=problems(401, 404, 422, 503))
async def get_job(service: ServiceDep, job: JobId) -> Job:
    """State, progress, metrics, and the names of the artifacts."""
    return await service.jobs.do(JobStore.get, job)


@router.post("/{job}:cancel", responses=problems(401, 403, 404, 409, 422, 503))
async def cancel_job(service: ServiceDep, job: JobId) -> Job:
    """Stops a job within a second; no error where it is cancelled already."""
    return await service.jobs.do(JobStore.cancel, job)


@router.post(
    "/{job}:retry",
    status_code=201,
    response_model=Job,
    responses=_SAME_RETRY | problems(401, 403, 404, 409, 422, 429, 503, 507),
)
async def retry_job(response: Response, service: ServiceDep, job: JobId) -> Job:
    """A new job in place of a failed or cancelled one; a training goes on from its last checkpoint."""
    service.life.require_serving()
    successor, is_new = await service.jobs.retry(job)
    response.status_code = 201 if is_new else 200
    return successor


@router.delete("/{job}", status_code=204, responses=problems(401, 403, 404, 409, 422, 503))
async def delete_job(service: ServiceDep, job: JobId) -> None:
    """Removes a finished job and its files. The scene that it trained stays."""
    await service.delete_job(job)


@router.get("/{job}/log", response_class=PlainTextResponse, responses=_LOG | problems(401, 404, 422, 503))
async def get_job_log(service: ServiceDep, job: JobId, max_bytes: LogBytes = DEFAULT_LOG_BYTES) -> PlainTextResponse:
    """What the job's process wrote."""
    return PlainTextResponse(await service.jobs.do(JobStore.log_tail, job, max_bytes))


@router.get(
    "/{job}/artifacts/{name}",
    response_class=FileResponse,
    responses=_FILE | NOT_MODIFIED | problems(401, 404, 422, 503),
)
async def get_artifact(
    request: Request,
    service: ServiceDep,
    job: JobId,
    name: Annotated[str, Path(description="One of the job's artifacts.")],
    show: Annotated[bool, Query(description="A browser shows it instead of saving it; pages run no scripts.")] = False,
) -> Response:
    """Downloads a file that the job made. Ranges are answered, so that a download can go on."""
    artifact = await service.jobs.do(JobStore.artifact, job, name)
    media_type = MEDIA_TYPES.get(PurePosixPath(name).suffix, _ANY_FILE)
    disposition = "inline" if show else "attachment"
    return artifact_response(artifact, request.headers, media_type, disposition)


@router.get("/{job}/events", response_class=StreamingResponse, responses=_EVENTS | problems(401, 404, 422, 503))
async def watch_job(service: ServiceDep, job: JobId, last_event_id: LastEventId = "") -> StreamingResponse:
    """Follows a job. A stream that ends before the final state goes on where it ended: say the id of its last event."""
    service.life.require_serving()
    last = LastEvent.read(last_event_id)
    return StreamingResponse(
        _events(await service.jobs.hub.watch(job, last.log_offset), last),
        media_type=EVENTS_TYPE,
        headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"},  # the second: proxies pass it on at once
    )


# A page that a job made is shown without scripts, in an origin of its own, and fetches nothing.
SHOWN = {
    "content-security-policy": "sandbox; default-src 'none'; style-src 'unsafe-inline'; img-src data:; "
    "frame-ancestors 'self'",
    "x-content-type-options": "nosniff",
}
_CHUNK_BYTES = 2**20
_RANGE = re.compile(r"bytes=(\d*)-(\d*)")


def artifact_response(file: Artifact, request_headers: Headers, media_type: str, disposition: str) -> Response:
    """The answer to a GET of a file or of one range of it; `disposition`: inline or attachment."""
    etag = f'"{file.stored.sha256}"'
    headers = {
        **SHOWN,
        "accept-ranges": "bytes",
        "content-disposition": f"{disposition}; filename*=utf-8''{quote(file.name)}",
        "etag": etag,
    }
    if is_known(request_headers, etag):
        return Response(status_code=304, headers={"etag": etag})
    start, end, status = 0, file.stored.bytes, 200
    if (
        request_headers.get("if-range", etag) == etag
        and (match := _RANGE.fullmatch(request_headers.get("range", "")))
        and any(match.groups())
    ):
        first, last = match.groups()
        start = int(first) if first else max(0, end - int(last))
        if first and last:
            end = min(end, int(last) + 1)
        if start >= end:
            return Response(status_code=416, headers={"content-range": f"bytes */{file.stored.bytes}"})
        status = 206
        headers["content-range"] = f"bytes {start}-{end - 1}/{file.stored.bytes}"
    headers["content-length"] = str(end - start)
    return StreamingResponse(_bytes(file, start, end), status_code=status, headers=headers, media_type=media_type)


async def _bytes(file: Artifact, start: int, end: int) -> AsyncIterator[bytes]:
    while start < end:
        chunk = await asyncio.to_thread(_read, file, start, min(_CHUNK_BYTES, end - start))
        start += len(chunk)
        yield chunk


def _read(file: Artifact, start: int, length: int) -> bytes:
    if not (chunk := file.read(start, length)):
        raise OSError("the file is shorter than its record says")  # ends the connection: the client sees that
    return chunk


@router.get("/{job}/curve", responses=problems(401, 404, 422, 503))
async def get_curve(service: ServiceDep, job: JobId) -> TrainingCurve:
    """Loss and held-out PSNR of a training so far, in at most 500 points."""
    return await service.training_views.curve(job)


@router.get("/{job}/preview", response_class=Response, responses=_PREVIEW | problems(401, 404, 422, 500, 503, 504, 507))
async def get_preview(service: ServiceDep, job: JobId) -> Response:
    """A held-out frame, rendered from the last checkpoint of a running training: a new one comes every ten seconds."""
    service.life.require_serving()
    return Response(await service.training_views.preview_png(job), media_type=PNG)


workers_router = APIRouter(prefix="/v1/workers", tags=["jobs"])

WorkerName = Annotated[str, Path(description="Name of the worker.")]


@workers_router.get("", responses=problems(401, 503))
async def list_workers(service: ServiceDep) -> WorkerList:
    """Who does the jobs, and what is at hand."""
    return await service.jobs.workers()


@workers_router.post("/{worker}:pause", responses=problems(401, 403, 404, 422, 503))
async def pause_worker(service: ServiceDep, worker: WorkerName) -> Worker:
    """Lets a worker take no more jobs; it ends the one at hand. Holds until it is resumed, restarts included."""
    return await service.jobs.do(JobStore.want, worker, Wanted.PAUSE)


@workers_router.post("/{worker}:drain", responses=problems(401, 403, 404, 422, 503))
async def drain_worker(service: ServiceDep, worker: WorkerName) -> Worker:
    """As pause, but a training at hand goes back into the queue at once, and on elsewhere from its checkpoint."""
    return await service.jobs.do(JobStore.want, worker, Wanted.DRAIN)


@workers_router.post("/{worker}:resume", responses=problems(401, 403, 404, 422, 503))
async def resume_worker(service: ServiceDep, worker: WorkerName) -> Worker:
    """Lets a worker take jobs again."""
    return await service.jobs.do(JobStore.want, worker, Wanted.WORK)
