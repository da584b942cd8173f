"""Training and batch rendering in the background."""

from __future__ import annotations

import asyncio
from pathlib import PurePosixPath
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Header, Path, Query
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response, StreamingResponse

from ultragray.contract import under
from ultragray.errors import InvalidArgument
from ultragray_service.core.catalog import DEFAULT_PAGE_SIZE, MAX_PAGE_SIZE
from ultragray_service.core.jobs.estimates import JobEstimate, estimate
from ultragray_service.core.jobs.jobs import JobPage
from ultragray_service.core.jobs.log import DEFAULT_LOG_BYTES, MAX_LOG_BYTES
from ultragray_service.http.deps import ServiceDep, problems
from ultragray_service.http.examples import JOB_EXAMPLES
from ultragray_service.http.job_events import EVENTS_TYPE, JobEvents, LastEvent
from ultragray_service.http.reading.accept import NPZ, PNG
from ultragray_service.http.reading.bodies import SPECIFICATION, JobBody
from ultragray_service.http.reading.json_body import body_schema, read_json_body
from ultragray_service.http.routes.jobs.artifacts import SHOWN, shared_file_response
from ultragray_workers.jobs.job import Job, JobState
from ultragray_workers.jobs.kinds import KINDS, Specification
from ultragray_workers.jobs.shared.reading import SharedFile
from ultragray_workers.jobs.specification import from_dict
from ultragray_workers.jobs.store import JobStore

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
PageToken = Annotated[str, Query(description="next_page_token of the page before.")]
LogBytes = Annotated[int, Query(ge=1, le=MAX_LOG_BYTES, description="How much of the log's end is given.")]
LastEventId = Annotated[str, Header(alias="Last-Event-ID", description="Id of the last event of an earlier stream.")]

_SUBMIT = body_schema(JobBody, JOB_EXAMPLES)
_Answers = dict[int | str, dict[str, Any]]
_SAME_JOB: _Answers = {200: {"model": Job, "description": "The job that this request_id made before."}}
_SAME_RETRY: _Answers = {200: {"model": Job, "description": "The job that an earlier call made."}}
_LOG: _Answers = {200: {"description": "The end of the log.", "content": {"text/plain": {}}}}
_FILE: _Answers = {
    200: {
        "description": "The file.",
        "content": {
            media_type: {"schema": {"type": "string", "format": "binary"}}
            for media_type in (*MEDIA_TYPES.values(), _ANY_FILE)
        },
    }
}
_EVENTS: _Answers = {
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
    service.require_serving()
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
    service.require_serving()
    body = await read_json_body(request, JobBody, SPECIFICATION)
    return await estimate(service, await _specification(body), field=SPECIFICATION.key)


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
    service.require_serving()
    successor, is_new = await service.jobs.retry(job)
    response.status_code = 201 if is_new else 200
    return successor


@router.delete("/{job}", status_code=204, responses=problems(401, 403, 404, 409, 422, 503))
async def delete_job(service: ServiceDep, job: JobId) -> None:
    """Removes a finished job and its files. The scene that it trained stays."""
    await service.delete_job(job)


@router.get(
    "/{job}/log",
    response_class=PlainTextResponse,
    responses=_LOG | problems(401, 404, 422, 503),
)
async def get_job_log(service: ServiceDep, job: JobId, max_bytes: LogBytes = DEFAULT_LOG_BYTES) -> PlainTextResponse:
    """What the job's process wrote."""
    return PlainTextResponse(await service.jobs.do(JobStore.log_tail, job, max_bytes))


@router.get(
    "/{job}/artifacts/{name}",
    response_class=FileResponse,
    responses=_FILE | problems(401, 404, 422, 503),
)
async def get_artifact(
    request: Request,
    service: ServiceDep,
    job: JobId,
    name: Annotated[str, Path(description="One of the job's artifacts.")],
    show: Annotated[bool, Query(description="A browser shows it instead of saving it; pages run no scripts.")] = False,
) -> Response:
    """Downloads a file that the job made. Ranges are answered, so that a download can go on."""
    found = await service.jobs.do(JobStore.artifact, job, name)
    media_type = MEDIA_TYPES.get(PurePosixPath(name).suffix, _ANY_FILE)
    disposition = "inline" if show else "attachment"
    if isinstance(found, SharedFile):
        return shared_file_response(found, request.headers, media_type, SHOWN, disposition)
    return FileResponse(
        found, media_type=media_type, filename=name, headers=SHOWN, content_disposition_type=disposition
    )


@router.get(
    "/{job}/events",
    response_class=StreamingResponse,
    responses=_EVENTS | problems(401, 404, 422, 503),
)
async def watch_job(service: ServiceDep, job: JobId, last_event_id: LastEventId = "") -> JobEvents:
    """Follows a job. A stream that ends before the final state goes on where it ended: say the id of its last event."""
    service.require_serving()
    last = LastEvent.read(last_event_id)
    return JobEvents(await service.jobs.hub.watch(job, last.log_offset), last)
