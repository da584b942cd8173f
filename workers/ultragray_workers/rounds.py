"""Loops that go on for as long as their process, whatever one of their rounds raises."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager

_REMIND_S = 600.0


class Rounds:
    """The rounds of a loop in a thread or task. What a round raises is logged, and the loop goes on with the next.

    A loop that ended would watch nothing any more, and nobody would notice: a thread's exception goes to stderr, a
    task's is told when it is collected.
    """

    def __init__(self, what: str, log: logging.Logger) -> None:
        """`what` the loop does, for the log: "the watch over open sessions"."""
        self._what, self._log = what, log
        self._failure: tuple[str, float] | None = None  # what was logged last, and when; None: the last round was good

    @contextmanager
    def round(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            now = time.monotonic()
            name = f"{type(error).__name__}: {error}"
            if self._failure is None or self._failure[0] != name or now - self._failure[1] >= _REMIND_S:
                self._log.exception("%s failed, and goes on with its next round", self._what)
                self._failure = name, now
        else:
            if self._failure is not None:
                self._log.warning("%s is in order again", self._what)
            self._failure = None


async def repeat(what: str, log: logging.Logger, interval_s: float, work: Callable[[], Awaitable[object]]) -> None:
    """Does `work` in rounds, for ever, with pauses of `interval_s` seconds; `what` as of `Rounds`."""
    rounds = Rounds(what, log)
    while True:
        with rounds.round():
            await work()
        await asyncio.sleep(interval_s)
