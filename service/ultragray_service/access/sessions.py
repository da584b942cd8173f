"""What is under way, so that it ends when its key is revoked or expires."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from ..errors import Unauthenticated
from .guard import Guard
from .principal import LOCAL, Principal

LOOK_INTERVAL_S = 1.0


@dataclass(eq=False)
class _Session:
    credential: str | None
    task: asyncio.Task[Any]
    error: Unauthenticated | None = None


class Sessions:
    """Requests, calls and streams, each with the credential that it was let in with."""

    def __init__(self, guard: Guard) -> None:
        self._guard = guard
        self._open: set[_Session] = set()

    @contextmanager
    def held(self, principal: Principal, credential: str | None) -> Iterator[None]:
        """Cancels the body, and raises Unauthenticated, when the credential counts no more."""
        task = asyncio.current_task()
        assert task is not None
        session = _Session(None if principal is LOCAL else credential, task)
        self._open.add(session)
        try:
            yield
        except asyncio.CancelledError:
            if session.error is None:
                raise
            raise session.error from None
        finally:
            self._open.discard(session)

    async def follow(self) -> None:
        """Looks at all credentials every second, for ever."""
        while True:
            await asyncio.sleep(LOOK_INTERVAL_S)
            for session in list(self._open):
                try:
                    self._guard.authenticate(session.credential)
                except Unauthenticated as error:
                    if session.error is None:
                        session.error = error
                        session.task.cancel()
