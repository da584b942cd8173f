"""Waiting for the next part of an upload, for a limited time."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable
from typing import Any, TypeVar

from ultragray_workers.errors import DeadlineExceeded, Draining

T = TypeVar("T")


async def arrival(arriving: Awaitable[T], idle_timeout_s: float, stopping: asyncio.Future[Any]) -> T:
    """The result of `arriving`.

    Raises DeadlineExceeded where it does not come in time, Draining once `stopping` is done.
    """
    work = asyncio.ensure_future(arriving)
    either: set[asyncio.Future[Any]] = {work, stopping}
    try:
        await asyncio.wait(either, timeout=idle_timeout_s, return_when=asyncio.FIRST_COMPLETED)
        if stopping.done():
            raise Draining("the service is stopping; send it again")
        if not work.done():
            raise DeadlineExceeded(f"the upload sent nothing for {idle_timeout_s:g} s")
        return work.result()
    finally:
        work.cancel()
