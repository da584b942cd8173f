"""The audit log as people ask for it."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa

from ultragray.contract import described
from ultragray.errors import InvalidArgument
from ultragray_service.access.audit import Entry, read_audit
from ultragray_service.access.principals import iso_time

DEFAULT_HOURS = 24.0
DEFAULT_ENTRIES = 1000
MAX_HOURS = 24.0 * 366
MAX_ENTRIES = 10_000
_HOUR_S = 3600.0


@dataclass(frozen=True)
class AuditEntry:
    """One line of the audit log."""

    at: str = described("ISO 8601, UTC.")
    who: str = described("The name of the key; -: without a known one.")
    address: str = described("That connected.")
    what: str = described("The operation, such as scene.delete.")
    target: str = described("The scene, dataset or job; empty: none.")
    result: str = described("OK, or the reason of the refusal.")
    facts: Mapping[str, Any] = described("Such as count or frames.", factory=dict)

    @classmethod
    def of(cls, entry: Entry) -> AuditEntry:
        return cls(iso_time(entry.at_s), entry.who, entry.address, entry.what, entry.target, entry.result, entry.facts)


@dataclass(frozen=True)
class AuditEntries:
    """The last lines of the audit log."""

    entries: list[AuditEntry] = described("Oldest first.")


async def audit_entries(
    engine: sa.Engine, *, since_hours: float, who: str | None, what: str | None, limit: int
) -> AuditEntries:
    if not 0.0 < since_hours <= MAX_HOURS:
        raise InvalidArgument(f"since_hours must be above 0 and at most {MAX_HOURS:g}", field="since_hours")
    if not 1 <= limit <= MAX_ENTRIES:
        raise InvalidArgument(f"limit must be an integer from 1 to {MAX_ENTRIES}, got {limit}", field="limit")
    since_s = time.time() - since_hours * _HOUR_S
    found = await asyncio.to_thread(read_audit, engine, since_s=since_s, who=who, what=what, limit=limit)
    return AuditEntries([AuditEntry.of(entry) for entry in found])
