"""Calls over a channel, asked again where that may help."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator, Callable
from contextlib import asynccontextmanager
from functools import partial
from typing import Any, TypeVar

from ..connection import Conversation, Operation, Pages, Stubs, call_metadata, check_timeout, is_done
from ..errors import ClientError, Unavailable
from ..pose_exchange import PoseExchange
from ..retries import Retries
from ..statuses import client_errors
from .transport import PoseCall, open_channel

T = TypeVar("T")


class AsyncConnection:
    """A channel and what goes with every call. All raise ClientError."""

    def __init__(self, address: str, api_key: str | None, timeout_s: float) -> None:
        self.address = address
        self._timeout_s = check_timeout(timeout_s)
        self._metadata = call_metadata(api_key)
        self._channel = open_channel(address)
        self._stubs = Stubs(self._channel)

    async def close(self) -> None:
        await self._channel.close()

    async def answer(self, operation: Operation[T], timeout_s: float | None) -> T:
        """The answer of an operation, within `timeout_s` (None: the client's) for all attempts together."""
        retries = self._retries(self._timeout_s if timeout_s is None else timeout_s)
        return await self._answer(operation, lambda: operation.request, retries)

    async def answer_upload(
        self, operation: Operation[T], messages: Callable[[], AsyncIterator[Any]], timeout_s: float | None
    ) -> T:
        """The answer of an operation that sends all `messages` at each attempt; None: as long as it takes."""
        return await self._answer(operation, messages, self._retries(timeout_s))

    async def all_pages(self, pages: Pages[T], timeout_s: float | None) -> tuple[T, ...]:
        """The items of a list."""
        for operation in pages.operations():
            pages.take(await self.answer(operation, timeout_s))
        return tuple(pages.items)

    async def converse(self, conversation: Conversation[T], timeout_s: float | None) -> AsyncGenerator[T, None]:
        """What a conversation makes of the messages as they come; None: as long as it takes."""
        retries = self._retries(timeout_s)
        while (request := conversation.request()) is not None:
            try:
                async with self._streamed(conversation.method, request, retries) as messages:
                    async for message in messages:
                        retries.progress()
                        yield conversation.take(message)
                conversation.end_of_call()
            except ClientError as error:
                await asyncio.sleep(conversation.pause_s(error, retries))

    def pose_call(self, exchange: PoseExchange, timeout_s: float | None) -> PoseCall:
        """The call of a stream, which ends after `timeout_s`; None: it may last."""
        timeout = None if timeout_s is None else check_timeout(timeout_s)
        start = self._stubs.method("rendering.RenderStream")
        return PoseCall(partial(start, timeout=timeout, metadata=self._metadata), exchange)

    def _retries(self, timeout_s: float | None) -> Retries:
        return Retries(None if timeout_s is None else check_timeout(timeout_s), self._timeout_s)

    async def _answer(self, operation: Operation[T], request: Callable[[], Any], retries: Retries) -> T:
        method = self._stubs.method(operation.method)
        broke = False
        while True:
            try:
                with client_errors(self.address):
                    answer = await method(request(), timeout=retries.remaining_s(), metadata=self._metadata)
                return operation.convert(answer)
            except ClientError as error:
                if is_done(operation, error, broke):
                    return operation.convert(None)
                broke |= isinstance(error, Unavailable)
                await asyncio.sleep(retries.pause_s(error))

    @asynccontextmanager
    async def _streamed(self, method: str, request: Any, retries: Retries) -> AsyncIterator[Any]:
        """The messages that a call streams; the call ends with the context."""
        call = self._stubs.method(method)(request, timeout=retries.remaining_s(), metadata=self._metadata)
        try:
            with client_errors(self.address):
                yield call
        finally:
            call.cancel()
