"""Questions to the database of the jobs, asked in threads of their own: a silent one keeps nobody else waiting."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from functools import partial
from typing import Concatenate, ParamSpec, TypeVar

from ultragray_workers.errors import DatabaseUnavailable

PATIENCE_S = 10.0  # with a database that is there and says nothing
_THREADS = 4

D = TypeVar("D")  # a store or an engine
P = ParamSpec("P")
T = TypeVar("T")


class DatabaseThreads:
    def __init__(self) -> None:
        self.executor = ThreadPoolExecutor(_THREADS, "database")

    async def ask(
        self, question: Callable[Concatenate[D, P], T], target: D, *details: P.args, **options: P.kwargs
    ) -> T:
        """Calls `question(target, *details, **options)` in a thread, in the caller's context.

        What is hidden from the caller is not found.

        Raises what it raises, and DatabaseUnavailable where there is no answer within PATIENCE_S.
        """
        call = partial(copy_context().run, question, target, *details, **options)
        answer = asyncio.get_running_loop().run_in_executor(self.executor, call)
        try:
            return await asyncio.wait_for(answer, PATIENCE_S)
        except asyncio.TimeoutError:
            raise DatabaseUnavailable(
                f"the database of the jobs has not answered for {PATIENCE_S:g} s: try again later"
            ) from None
