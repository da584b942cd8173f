"""Is the process alive; would it render and take jobs."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal

from fastapi import APIRouter
from starlette.responses import Response

from ultragray.contract import described
from ultragray_service.core.readiness.readiness import Components
from ultragray_service.http.deps import ServiceDep, problems
from ultragray_service.http.problems import problem_response


@dataclass(frozen=True)
class Live:
    """The process runs."""

    status: Literal["live"] = "live"


@dataclass(frozen=True)
class Ready:
    """Frames are rendered, and jobs are taken unless `ready_without_jobs` is set."""

    components: Components
    status: Literal["ready"] = "ready"
    identity_provider: Literal["available", "unavailable"] | None = described(
        "Whether the issuer of tokens answers; null where no tokens are taken.", None
    )


router = APIRouter(prefix="/v1/health", tags=["health"])


@router.head("/live", include_in_schema=False)
@router.get("/live")
async def live() -> Live:
    """200 as long as the process runs."""
    return Live()


@router.head("/ready", include_in_schema=False, response_model=Ready)
@router.get("/ready", response_model=Ready, responses=problems(503, members={"components": Components}))
async def ready(service: ServiceDep) -> Ready | Response:
    """200 while frames are rendered and jobs are taken.

    503 while the service starts (NOT_READY) or stops (DRAINING), no frame would be rendered (NOT_READY), or the jobs'
    database (DATABASE_UNAVAILABLE) or the artifact folder (ARTIFACT_FOLDER_UNAVAILABLE) is away: `components` tells of
    every part, in both answers. A bucket of scenes that is away (STORAGE_UNAVAILABLE) counts once its list is older
    than ULTRAGRAY_SCENE_LIST_MAX_AGE_S. With ULTRAGRAY_READY_WITHOUT_JOBS database and artifact folder are told and do
    not count.
    """
    readiness = service.readiness
    components = readiness.components
    if readiness.problem is not None:
        return problem_response(readiness.problem, members={"components": asdict(components)})
    if service.tokens is None:
        return Ready(components)
    is_available = service.tokens.issuer.problem is None
    return Ready(components, identity_provider="available" if is_available else "unavailable")
