"""So many in any second, for each client apart."""

from __future__ import annotations

import asyncio
import time
from weakref import WeakValueDictionary

from limits import RateLimitItemPerSecond
from limits.storage import MemoryStorage
from limits.strategies import MovingWindowRateLimiter

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
        first_leaves_s, left = self._windows.get_window_stats(item, client)
        wait_s = first_leaves_s - time.time()
        if wait_s > WINDOW_S:  # the clock was set back
            self._windows.clear(item, client)
            return self.take(client, per_s, count)
        return (max(0.0, wait_s) if count <= left + 1 else WINDOW_S) + _MARGIN_S

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
