"""The service at work: its frames and its jobs in numbers, and Prometheus."""

from __future__ import annotations

import asyncio

from fastapi import APIRouter
from prometheus_client import CONTENT_TYPE_LATEST
from starlette.responses import Response

from ultragray import __version__
from ultragray_service.http.deps import ServiceDep, problems
from ultragray_service.telemetry.statistics import ServiceStatistics, memory_bytes

router = APIRouter()


@router.get("/v1/statistics", tags=["statistics"], responses=problems(401))
async def get_statistics(service: ServiceDep) -> ServiceStatistics:
    """Frames, times and errors of the last ten minutes in steps of 5 s, and what waits and runs now."""
    pool = service.pool.statistics()
    return ServiceStatistics(
        steps=service.metrics.statistics.summaries(),
        waiting_frames=pool.waiting_frames,
        busy_processes=pool.busy,
        processes=pool.processes_alive,
        process_restarts=pool.restarts_total,
        memory_bytes=await asyncio.to_thread(memory_bytes, pool.pids),
        loaded_scenes=len(service.pool.loaded()),
        version=__version__,
        renderer=pool.renderer,
        jobs={state.value: count for state, count in service.jobs.overview.counts.items()},
    )


@router.get(
    "/metrics",
    tags=["metrics"],
    response_class=Response,
    responses={200: {"description": "The Prometheus text format.", "content": {"text/plain": {}}}},
)
async def metrics(service: ServiceDep) -> Response:
    """Requests, frames, queue, render and encode times, and the state of the render pool."""
    return Response(service.metrics.exposition(), media_type=CONTENT_TYPE_LATEST)
