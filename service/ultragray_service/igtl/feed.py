"""Subscriptions of a client: the newest frame that it has not seen, at most as often as it asked for."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Awaitable, Callable
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass

from ultragray_service.igtl.frames import Frame
from ultragray_service.igtl.messages import Message

Turn = Callable[[], AbstractAsyncContextManager[None]]


@dataclass
class _Subscription:
    name: str
    interval_s: float
    version: int
    due: float = 0.0  # time.monotonic(), s


class Feed:
    """The subscriptions of one client, by kind of message. Holds one frame for each at most."""

    def __init__(self, turn: Turn, send: Callable[[Message], Awaitable[None]]) -> None:
        """`turn` is entered for each message, and waits until the client has read what came before."""
        self._turn = turn
        self._send = send
        self._subscriptions: dict[str, _Subscription] = {}
        self._fresh: dict[str, Frame] = {}
        self._changed = asyncio.Event()

    def start(self, kind: str, name: str, interval_s: float, version: int) -> None:
        """From now on frames that go by `name` are told as messages of `kind`."""
        self._subscriptions[kind] = _Subscription(name, interval_s, version)
        self._changed.set()

    def stop(self, kind: str) -> None:
        """No longer."""
        self._subscriptions.pop(kind, None)
        self._fresh.pop(kind, None)

    def offer(self, frame: Frame, *, is_own: bool) -> None:
        """A frame was rendered; its sender gets the image anyway."""
        for kind, subscription in self._subscriptions.items():
            if frame.goes_by(subscription.name) and not (is_own and kind == "IMAGE"):
                self._fresh[kind] = frame
                self._changed.set()

    async def run(self) -> None:
        """Sends until cancelled. Raises what `send` raises."""
        while True:
            await self._wait(self._next_due())
            now = time.monotonic()
            for kind in [kind for kind in self._fresh if self._subscriptions[kind].due <= now]:
                async with self._turn():
                    if (frame := self._fresh.pop(kind, None)) is not None:  # may have been stopped meanwhile
                        subscription = self._subscriptions[kind]
                        subscription.due = time.monotonic() + subscription.interval_s
                        await self._send(frame.message(kind, subscription.version))

    def _next_due(self) -> float | None:
        return min((self._subscriptions[kind].due for kind in self._fresh), default=None)

    async def _wait(self, until: float | None) -> None:
        """Until that time.monotonic(), or a change."""
        timeout_s = None if until is None else until - time.monotonic()
        if timeout_s is None or timeout_s > 0:
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._changed.wait(), timeout_s)
        self._changed.clear()
