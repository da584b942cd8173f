"""Whether the service is ready, what it is and counts, who asks, and who did what."""

from __future__ import annotations

import asyncio
from dataclasses import asdict, dataclass
from typing import Annotated, Literal

from fastapi import APIRouter, Query
from prometheus_client import CONTENT_TYPE_LATEST
from starlette.responses import Response

from ultragray import __version__
from ultragray.contract import described
from ultragray_service.access.audit import (
    DEFAULT_ENTRIES,
    DEFAULT_HOURS,
    MAX_ENTRIES,
    MAX_HOURS,
    AuditEntries,
    audit_entries,
)
from ultragray_service.access.principals import Me, me
from ultragray_service.core.readiness import Components
from ultragray_service.doors import ServiceInfo
from ultragray_service.http.dependencies import ServiceDep, problems
from ultragray_service.http.problems import problem_response
from ultragray_service.telemetry.metrics import ServiceStatistics, memory_bytes


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


service_router = APIRouter(prefix="/v1/service", tags=["service"])


@service_router.get("", responses=problems(401))
async def get_service(service: ServiceDep) -> ServiceInfo:
    """Version, and the ports of gRPC and OpenIGTLink, for pages that tell how to connect."""
    return service.doors.info(key_required=service.guard.asks)


statistics_router = APIRouter()


@statistics_router.get("/v1/statistics", tags=["statistics"], responses=problems(401))
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


@statistics_router.get(
    "/metrics",
    tags=["metrics"],
    response_class=Response,
    responses={200: {"description": "The Prometheus text format.", "content": {"text/plain": {}}}},
)
async def metrics(service: ServiceDep) -> Response:
    """Requests, frames, queue, render and encode times, and the state of the render pool."""
    return Response(service.metrics.exposition(), media_type=CONTENT_TYPE_LATEST)


@dataclass(frozen=True)
class SignInProvider:
    """An OpenID Connect provider that people sign in with: authorization code with PKCE, as a public client."""

    authorization_endpoint: str
    token_endpoint: str
    client_id: str
    scope: str = described("Scopes to ask for, with spaces between them.")


@dataclass(frozen=True)
class SignIn:
    """How people sign in."""

    provider: SignInProvider | None = described(
        "null: people sign in with keys alone, or the provider does not answer at the moment."
    )


access_router = APIRouter(prefix="/v1", tags=["access"])


@access_router.get("/me", responses=problems(401))
async def who_am_i(service: ServiceDep) -> Me:
    """The name and the role that the key stands for."""
    return me(service.guard.asks)


@access_router.get("/audit", responses=problems(401, 403, 422, 503))
async def list_audit_entries(
    service: ServiceDep,
    since_hours: Annotated[float, Query(gt=0.0, le=MAX_HOURS, description="How far back.")] = DEFAULT_HOURS,
    who: Annotated[str | None, Query(description="Only of this name.")] = None,
    what: Annotated[str | None, Query(description="Only this operation, such as scene.delete, or scene.")] = None,
    limit: Annotated[int, Query(ge=1, le=MAX_ENTRIES, description="The last ones, at most.")] = DEFAULT_ENTRIES,
) -> AuditEntries:
    """Who did what: the last entries of the audit log, of all services that share the database."""
    return await audit_entries(service.jobs.database.engine, since_hours=since_hours, who=who, what=what, limit=limit)


@access_router.get("/sign-in")
async def get_sign_in(service: ServiceDep) -> SignIn:
    """How people sign in. Needs no key."""
    client_id = service.settings.oidc_client_id
    endpoints = None if service.tokens is None else service.tokens.issuer.endpoints
    if client_id is None or endpoints is None:
        return SignIn(None)
    return SignIn(SignInProvider(endpoints.authorization, endpoints.token, client_id, service.settings.oidc_scope))
