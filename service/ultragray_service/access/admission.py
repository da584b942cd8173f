"""Admission of requests, calls and streams: what a caller may do runs within it, whichever door it came through."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from ultragray_service.access.audit import AuditLog
from ultragray_service.access.credentials import Sessions
from ultragray_service.access.limits import Limits
from ultragray_service.access.owners import Permissions
from ultragray_service.access.principals import Principal, act_as
from ultragray_service.access.rules import Operation


class Admission:
    def __init__(self, audit: AuditLog, limits: Limits, sessions: Sessions, permissions: Permissions) -> None:
        self._audit, self._limits, self._sessions, self._permissions = audit, limits, sessions, permissions

    @asynccontextmanager
    async def permitted(
        self,
        principal: Principal,
        credential: str | None,
        operation: Operation,
        target: str,
        *,
        address: str,
        connection: str,
    ) -> AsyncIterator[None]:
        """What a caller may do runs within: counted, audited, and cut off when the credential counts no more.

        `connection`: the caller's address with the port. Raises RateLimited, PermissionDenied and JobNotFound.
        """
        act_as(principal, address=address, connection=connection)
        with self._audit.refusals(principal.name, address, operation, target):
            self._limits.take_request()
        with (
            self._audit.request(principal.name, address, operation, target),
            self._sessions.held(principal, credential),
        ):
            await self._permissions.require(principal, operation, target)
            yield
