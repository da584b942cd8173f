"""Is the process alive; would it render."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from fastapi import APIRouter

from ..deps import ServiceDep, problems


@dataclass(frozen=True)
class Live:
    """The process runs."""

    status: Literal["live"] = "live"


@dataclass(frozen=True)
class Ready:
    """Frames are rendered."""

    status: Literal["ready"] = "ready"


router = APIRouter(prefix="/v1/health", tags=["health"])


@router.head("/live", include_in_schema=False)
@router.get("/live")
async def live() -> Live:
    """200 as long as the process runs."""
    return Live()


@router.head("/ready", include_in_schema=False)
@router.get("/ready", responses=problems(503))
async def ready(service: ServiceDep) -> Ready:
    """200 while frames are rendered; 503 while the service starts (NOT_READY) or stops (DRAINING)."""
    service.require_ready()
    return Ready()
