"""The caller, as the service tells them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


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
