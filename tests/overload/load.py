"""Load on a door: connections that ask one after another, or pour poses, and what they saw."""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np


class Refused(Exception):
    """The service has refused a request, for this reason."""


class Connection(Protocol):
    """One connection of a client."""

    async def ask(self) -> None:
        """One pose, one frame. Raises Refused."""

    async def pour(self, rate: float, until: float, seen: Seen) -> None:
        """Sends poses at a rate until a time of `time.monotonic()`, whatever comes back; 0: as fast as frames come."""

    async def close(self) -> None:
        """Ends it."""


@dataclass
class Seen:
    """What came back."""

    latencies_s: list[float] = field(default_factory=list)  # of the frames
    refusals: Counter[str] = field(default_factory=Counter)
    asked: int = 0

    def take(self, latency_s: float) -> None:
        self.latencies_s.append(latency_s)

    @property
    def frames(self) -> int:
        return len(self.latencies_s)

    @property
    def p99_s(self) -> float:
        return float(np.percentile(self.latencies_s, 99)) if self.latencies_s else 0.0


async def ask_at(connection: Connection, rate: float, until: float, seen: Seen) -> None:
    """Asks at a rate, but not before the last answer is there; 0: as fast as answers come."""
    due = time.monotonic()
    while (now := time.monotonic()) < until:
        if rate:
            await asyncio.sleep(due - now)
            due = max(due + 1 / rate, time.monotonic())
        began = time.monotonic()
        seen.asked += 1
        try:
            await connection.ask()
        except Refused as refused:
            seen.refusals[str(refused)] += 1
        else:
            seen.take(time.monotonic() - began)
