"""Limits of whoever the running code works for: what goes beyond them is refused, or waits for its turn.

The package `limits` counts in moving windows. What it does not know is how to wait in turn, and what is under way.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from weakref import WeakValueDictionary

from limits import RateLimitItemPerSecond
from limits.storage import MemoryStorage
from limits.strategies import MovingWindowRateLimiter

from ultragray.errors import TooManyPoses, UltragrayError
from ultragray_service.access.principals import Allowance, Number, acting, caller
from ultragray_service.errors import LimitReached, RateLimited
from ultragray_workers.errors import QueueFull

WINDOW_S = 1.0
_MARGIN_S = 0.002  # the library counts what is exactly a window old


class Rate:
    """Moving windows of one second, one for each client. They belong to one event loop."""

    def __init__(self) -> None:
        self._windows = MovingWindowRateLimiter(MemoryStorage())
        self._queues: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()

    def take(self, client: str, per_s: int, count: int = 1) -> float:
        """Takes so many, at most `per_s`: 0.0; else takes none, and tells the seconds until there are as many."""
        item = RateLimitItemPerSecond(per_s)
        if self._windows.hit(item, client, cost=count):
            return 0.0
        first_leaves_s, remaining = self._windows.get_window_stats(item, client)
        wait_s = first_leaves_s - time.time()
        if wait_s > WINDOW_S:  # the clock was set back
            self._windows.clear(item, client)
            return self.take(client, per_s, count)
        return (max(0.0, wait_s) if count <= remaining + 1 else WINDOW_S) + _MARGIN_S

    async def wait(self, client: str, per_s: int, count: int = 1, *, until: float | None) -> float:
        """Takes so many when there are, first come, first served: 0.0.

        Where that would be after `until` (time.monotonic(), s) it takes none, and tells the seconds that are missing.
        """
        queue = self._queues.setdefault(client, asyncio.Lock())
        async with queue:
            while (wait_s := self.take(client, per_s, count)) > 0.0:
                if until is not None and time.monotonic() + wait_s > until:
                    return wait_s
                await asyncio.sleep(wait_s)
        return 0.0


class Slots:
    """Half of them are the most that one client has. Its methods belong to one event loop."""

    def __init__(self, count: int, what: str) -> None:
        """`what` takes them, in the plural."""
        self._count, self._what = count, what
        self._taken: Counter[str] = Counter()

    @contextmanager
    def one(self) -> Iterator[None]:
        """One for whoever the running code works for, as long as the body runs. Raises QueueFull."""
        client, most = caller().client, self._count // 2
        if self._taken.total() >= self._count:
            raise QueueFull(f"{self._count} {self._what} are under way already")
        if self._taken[client] >= most:
            raise QueueFull(f"{most} {self._what} of this client are under way already, the most that one may have")
        self._taken[client] += 1
        try:
            yield
        finally:
            self._taken[client] -= 1
            self._taken += Counter()  # without those that have none


class Limits:
    """What every client takes of this service. Its methods belong to one event loop."""

    def __init__(self, default: Allowance, on_refused: Callable[[str], None]) -> None:
        """`default`: of keys that have no limits of their own. `on_refused` is told the name of the limit."""

        @lru_cache(maxsize=1024)
        def allowance(own: tuple[tuple[str, Number | None], ...]) -> Allowance:
            return replace(default, **dict(own))  # type: ignore[arg-type]  # checked when the key was made

        self._allowance, self._on_refused = allowance, on_refused
        self._requests, self._frames = Rate(), Rate()
        self._streams: Counter[str] = Counter()

    @property
    def mine(self) -> Allowance:
        return self._allowance(acting().limits)

    def take_request(self) -> None:
        per_s = self.mine.requests_per_s
        if per_s is not None and (wait_s := self._requests.take(caller().client, per_s)):
            raise self.refused("requests_per_s", _too_fast("requests", per_s, wait_s))

    async def take_frames(self, count: int, deadline: float) -> None:
        """Counts the frames of a request, which is refused where the first cannot begin at once.

        More frames than a second may have wait for the seconds that they need. Raises RateLimited, and TooManyPoses
        where that would be after the `deadline` (time.monotonic(), s).
        """
        per_s = self.mine.frames_per_s
        if per_s is None:
            return
        needed_s = (math.ceil(count / per_s) - 1) * WINDOW_S
        if time.monotonic() + needed_s > deadline:
            raise self.refused(
                "frames_per_s",
                TooManyPoses(
                    f"this key may have {per_s} frames a second (frames_per_s), so that {count} take longer than the "
                    "timeout of the request: send fewer at once",
                    field="poses",
                ),
            )
        if wait_s := self._frames.take(caller().client, per_s, min(count, per_s)):
            raise self.refused("frames_per_s", _too_fast("frames", per_s, wait_s))
        for first in range(per_s, count, per_s):
            await self._wait_for_frames(per_s, min(per_s, count - first), deadline)

    async def frame_turn(self, deadline: float | None) -> None:
        """Counts a frame of a batch or stream in turn. Raises RateLimited after `deadline` (time.monotonic())."""
        if (per_s := self.mine.frames_per_s) is not None:
            await self._wait_for_frames(per_s, 1, deadline)

    @contextmanager
    def stream(self) -> Iterator[None]:
        client, most = caller().client, self.mine.streams
        if most is not None and self._streams[client] >= most:
            error = LimitReached(f"this key may have {most} streams at once (streams): end another one first")
            raise self.refused("streams", error)
        self._streams[client] += 1
        try:
            yield
        finally:
            self._streams[client] -= 1
            if not self._streams[client]:
                del self._streams[client]

    def refused(self, limit: str, error: UltragrayError) -> UltragrayError:
        self._on_refused(limit)
        return error

    async def _wait_for_frames(self, per_s: int, count: int, deadline: float | None) -> None:
        if wait_s := await self._frames.wait(caller().client, per_s, count, until=deadline):
            raise self.refused("frames_per_s", _too_fast("frames", per_s, wait_s))


def _too_fast(what: str, per_s: int, wait_s: float) -> RateLimited:
    return RateLimited(
        f"this key may have {per_s} {what} a second ({what}_per_s): try again in {wait_s:.2f} s", retry_after_s=wait_s
    )
