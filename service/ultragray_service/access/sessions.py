"""What is under way, so that it ends when its key is revoked or expires."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from ultragray.errors import UltragrayError
from ultragray_service.access.guard import Guard
from ultragray_service.access.principal import LOCAL, Principal
from ultragray_service.errors import IssuerUnavailable
from ultragray_workers.rounds import Rounds

LOOK_INTERVAL_S = 1.0

_log = logging.getLogger("ultragray.access")


@dataclass(eq=False)
class _Session:
    credential: str | None
    expires_at_s: float | None  # time.time() in seconds; None: never
    task: asyncio.Task[Any]
    error: UltragrayError | None = None
    looks: Rounds = field(default_factory=lambda: Rounds("the watch over an open session", _log))


class Sessions:
    """Requests, calls and streams, each with the credential that it was let in with."""

    def __init__(self, guard: Guard) -> None:
        self._guard = guard
        self._open: set[_Session] = set()

    @contextmanager
    def held(self, principal: Principal, credential: str | None) -> Iterator[None]:
        """Cancels the body, and raises why, when the credential counts no more."""
        task = asyncio.current_task()
        assert task is not None
        session = _Session(None if principal is LOCAL else credential, principal.expires_at_s, task)
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
                with session.looks.round():
                    self._look(session)

    def _look(self, session: _Session) -> None:
        try:
            self._guard.authenticate(session.credential)
        except UltragrayError as error:
            is_expired = session.expires_at_s is not None and session.expires_at_s <= time.time()
            if isinstance(error, IssuerUnavailable) and not is_expired:
                return  # the issuer changed its keys, or is away: the next round may know more
            if session.error is None:
                session.error = error
                session.task.cancel()
