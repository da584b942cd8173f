"""What a client of a stream gets for a pose."""

from __future__ import annotations

from dataclasses import dataclass

from ultragray.errors import UltragrayError
from ultragray_workers.pool.types import RenderResult


@dataclass(frozen=True, eq=False)
class Answered:
    """A frame, or why there is none."""

    sequence: int
    client_time: float | None
    outcome: RenderResult | UltragrayError
    dropped: int = 0  # poses that were replaced since the answer before
