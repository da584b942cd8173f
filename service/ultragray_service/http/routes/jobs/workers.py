"""The workers that do the jobs."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path

from ultragray_service.core.jobs.jobs import WorkerList
from ultragray_service.http.deps import ServiceDep, problems
from ultragray_workers.jobs.queue.attendance import Worker
from ultragray_workers.jobs.queue.wishes import Wanted
from ultragray_workers.jobs.store import JobStore

router = APIRouter(prefix="/v1/workers", tags=["jobs"])

WorkerName = Annotated[str, Path(description="Name of the worker.")]


@router.get("", responses=problems(401, 503))
async def list_workers(service: ServiceDep) -> WorkerList:
    """Who does the jobs, and what is at hand."""
    return await service.jobs.workers()


@router.post("/{worker}:pause", responses=problems(401, 403, 404, 422, 503))
async def pause_worker(service: ServiceDep, worker: WorkerName) -> Worker:
    """Lets a worker take no more jobs; it ends the one at hand. Holds until it is resumed, restarts included."""
    return await service.jobs.do(JobStore.want, worker, Wanted.PAUSE)


@router.post("/{worker}:drain", responses=problems(401, 403, 404, 422, 503))
async def drain_worker(service: ServiceDep, worker: WorkerName) -> Worker:
    """As pause, but a training at hand goes back into the queue at once, and on elsewhere from its checkpoint."""
    return await service.jobs.do(JobStore.want, worker, Wanted.DRAIN)


@router.post("/{worker}:resume", responses=problems(401, 403, 404, 422, 503))
async def resume_worker(service: ServiceDep, worker: WorkerName) -> Worker:
    """Lets a worker take jobs again."""
    return await service.jobs.do(JobStore.want, worker, Wanted.WORK)
