"""A long wait in a thread of its own: the few threads of the event loop's pool are for short work of all routes."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import TypeVar

T = TypeVar("T")


async def in_own_thread(work: Callable[[], T]) -> T:
    """Do `work`. Cancelling the caller leaves the thread to its work; it ends with the process."""
    loop = asyncio.get_running_loop()
    done: asyncio.Future[T] = loop.create_future()

    def run() -> None:
        try:
            result = work()
        except BaseException as error:
            tell(partial(done.set_exception, error))
        else:
            tell(partial(done.set_result, result))

    def tell(outcome: Callable[[], None]) -> None:
        with suppress(RuntimeError):  # the loop is closed: nobody waits
            loop.call_soon_threadsafe(lambda: None if done.done() else outcome())

    threading.Thread(target=run, daemon=True).start()
    return await done


async def to_its_end(work: Callable[[], T]) -> T:
    """Do `work` in a thread of its own. A cancelled caller still waits for its end."""
    working = asyncio.ensure_future(in_own_thread(work))
    try:
        return await asyncio.shield(working)
    finally:
        await asyncio.wait({working})
