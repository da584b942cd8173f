"""A part that is asked in a thread, again and again, whether it is in order."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from ultragray.errors import UltragrayError
from ultragray_service.core.own_thread import in_own_thread
from ultragray_workers.errors import NotReady
from ultragray_workers.rounds import Rounds

CHECK_INTERVAL_S = 5.0
PATIENCE_S = 5.0  # with a check that does not end

_log = logging.getLogger("ultragray.service")


class WatchedPart:
    """What a part said last: at most CHECK_INTERVAL_S + PATIENCE_S ago."""

    def __init__(self, name: str, check: Callable[[], None], error: type[UltragrayError]) -> None:
        """`check` blocks, and raises where the part is not in order; `error`: of one that does not return."""
        self._name, self._check = name, check
        self._silent = error(f"{name} has not answered for {PATIENCE_S:g} s")
        self._checking: asyncio.Task[None] | None = None
        self.problem: UltragrayError | None = NotReady("the service is starting")

    async def run(self) -> None:
        """Checks until it is cancelled."""
        rounds = Rounds(f"the watch over {self._name}", _log)
        while True:
            with rounds.round():
                await self.look()
            await asyncio.sleep(CHECK_INTERVAL_S)

    async def look(self) -> None:
        """Checks once. A check that hangs stays the only one until it ends."""
        if self._checking is None:
            self._checking = asyncio.ensure_future(in_own_thread(self._check))
        await asyncio.wait({self._checking}, timeout=PATIENCE_S)
        problem: UltragrayError | None = None
        if not self._checking.done():
            problem = self._silent
        else:
            ended, self._checking = self._checking, None
            try:
                ended.result()
            except UltragrayError as error:
                problem = error
        self._take(problem)

    def _take(self, problem: UltragrayError | None) -> None:
        before, self.problem = self.problem, problem
        if problem is not None and (before is None or before.detail != problem.detail):
            _log.warning(problem.detail)
        if problem is None and before is not None and not isinstance(before, NotReady):
            _log.warning(f"{self._name} is in order again")
