"""Work that is abandoned when its client goes away or its time is up."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Coroutine
from typing import Any, TypeVar

from starlette.requests import ClientDisconnect
from starlette.types import Receive

from ultragray_workers.errors import DeadlineExceeded

T = TypeVar("T")


async def finish_or_abandon(work: Coroutine[Any, Any, T], receive: Receive, deadline: float) -> T:
    """The result of `work`, cancelled where the client goes away or the deadline passes.

    `deadline` is in time.monotonic() seconds. The request's body must have been read.
    Raises ClientDisconnect, DeadlineExceeded, and what `work` raises.
    """
    working = asyncio.ensure_future(work)
    leaving = asyncio.ensure_future(_disconnected(receive))
    try:
        timeout_s = max(0.0, deadline - time.monotonic())
        await asyncio.wait({working, leaving}, timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED)
        if working.done():
            return working.result()
        if leaving.done():
            raise ClientDisconnect
        raise DeadlineExceeded("the deadline passed before the answer was ready")
    finally:
        working.cancel()
        leaving.cancel()


async def _disconnected(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass
