"""Who asks, how people sign in, and who did what."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from fastapi import APIRouter, Query

from ultragray.contract import described
from ultragray_service.access.principal import Me, me
from ultragray_service.http.deps import ServiceDep, problems
from ultragray_service.views.audited import (
    DEFAULT_ENTRIES,
    DEFAULT_HOURS,
    MAX_ENTRIES,
    MAX_HOURS,
    AuditEntries,
    audit_entries,
)


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


router = APIRouter(prefix="/v1", tags=["access"])


@router.get("/me", responses=problems(401))
async def who_am_i(service: ServiceDep) -> Me:
    """The name and the role that the key stands for."""
    return me(service.guard.asks)


@router.get("/audit", responses=problems(401, 403, 422, 503))
async def list_audit_entries(
    service: ServiceDep,
    since_hours: Annotated[float, Query(gt=0.0, le=MAX_HOURS, description="How far back.")] = DEFAULT_HOURS,
    who: Annotated[str | None, Query(description="Only of this name.")] = None,
    what: Annotated[str | None, Query(description="Only this operation, such as scene.delete, or scene.")] = None,
    limit: Annotated[int, Query(ge=1, le=MAX_ENTRIES, description="The last ones, at most.")] = DEFAULT_ENTRIES,
) -> AuditEntries:
    """Who did what: the last entries of the audit log, of all services that share the database."""
    return await audit_entries(service.jobs.database.engine, since_hours=since_hours, who=who, what=what, limit=limit)


@router.get("/sign-in")
async def get_sign_in(service: ServiceDep) -> SignIn:
    """How people sign in. Needs no key."""
    client_id = service.settings.oidc_client_id
    endpoints = None if service.tokens is None else service.tokens.issuer.endpoints
    if client_id is None or endpoints is None:
        return SignIn(None)
    return SignIn(SignInProvider(endpoints.authorization, endpoints.token, client_id, service.settings.oidc_scope))
