"""The last minutes of the service."""

from __future__ import annotations

import asyncio

from fastapi import APIRouter

from ...telemetry.statistics import ServiceStatistics, memory_bytes
from ..deps import ServiceDep, problems

router = APIRouter(prefix="/v1/statistics", tags=["statistics"])


@router.get("", responses=problems(401))
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
        jobs={state.value: count for state, count in service.jobs.counts.items()},
    )
