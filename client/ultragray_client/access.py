"""The caller, as the service tells them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any


class Role(str, Enum):
    """What a key may do; each role includes those before it."""

    READER = "reader"  # sees, renders, streams
    OPERATOR = "operator"  # and has jobs, datasets and scenes
    ADMIN = "admin"  # everything


@dataclass(frozen=True)
class Me:
    """Whom the key stands for."""

    name: str  # the owner of what they make
    role: Role
    expires_at: str | None  # ISO 8601, UTC; None: never
    key_required: bool  # without, everybody is an admin


@dataclass(frozen=True)
class AuditEntry:
    """One line of the service's audit log."""

    at: str  # ISO 8601, UTC
    who: str  # the name of the key; "-": without a known one
    address: str  # that connected
    what: str  # the operation, such as scene.delete
    target: str  # the scene, dataset or job; empty: none
    result: str  # OK, or the reason of the refusal
    facts: Mapping[str, Any]  # such as count or frames
