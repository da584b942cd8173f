# Generated from aio/connection.py by client/generate.py; change that file.
"""Calls over a channel, asked again where that may help."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from typing import Any, TypeAlias, TypeVar

from ultragray_client.connection import (
    LONGEST_PAUSE_OF_STREAMS_S,
    PAGE_SIZE,
    ApiKey,
    Conversation,
    Retries,
    Tls,
    check_address,
    check_reconnect,
    check_timeout,
    client_errors,
    metadata_of,
    warn_of_open_key,
)
from ultragray_client.exchange import PoseExchange

from ..errors import ClientError, NotFound
from .transport import PoseCall, open_channel

T = TypeVar("T")
Call: TypeAlias = Callable[..., Any]  # a method of a stub


class Connection:
    """A channel and what goes with every call. All raise ClientError."""

    def __init__(self, address: str, api_key: ApiKey | None, tls: Tls | None, timeout_s: float) -> None:
        self.address = check_address(address)
        self._timeout_s = check_timeout(timeout_s)
        self._api_key = api_key
        if api_key is not None and tls is None:
            warn_of_open_key(address)
        self.channel = open_channel(address, tls)

    def close(self) -> None:
        self.channel.close()

    def answer(self, call: Call, request: Any, timeout_s: float | None) -> Any:
        """The answer to a request, within `timeout_s` (None: the client's) for all attempts together."""
        return self._answer(call, lambda: request, request, self._short_retries(timeout_s))

    def delete(self, call: Call, request: Any, timeout_s: float | None) -> None:
        """Asks for a deletion. What is not found any more where an attempt broke off was deleted by that."""
        retries = self._short_retries(timeout_s)
        try:
            self._answer(call, lambda: request, request, retries)
        except NotFound:
            if not retries.was_unavailable:
                raise

    def upload(self, call: Call, messages: Callable[[], Iterator[Any]], timeout_s: float | None) -> Any:
        """The answer to messages that each attempt sends from the first one on; None: as long as it takes."""
        return self._answer(call, messages, None, self._retries(timeout_s))

    def listed(
        self, call: Call, request: Any, items: str, timeout_s: float | None, *, limit: int | None = None
    ) -> list[Any]:
        """The items of a list that comes in pages, at most `limit` of them."""
        found: list[Any] = []
        while limit is None or len(found) < limit:
            request.page_size = PAGE_SIZE if limit is None else min(PAGE_SIZE, limit - len(found))
            page = self.answer(call, request, timeout_s)
            found += getattr(page, items)
            request.page_token = page.next_page_token
            if not page.next_page_token:
                break
        return found

    def converse(self, call: Call, conversation: Conversation[T], timeout_s: float | None) -> Generator[T, None]:
        """The results of a conversation as its messages come; `timeout_s` None: as long as it takes."""
        retries = self._retries(timeout_s)
        while (request := conversation.request()) is not None:
            try:
                with self._streamed(call, request, retries) as messages:
                    for message in messages:
                        retries.progress()
                        yield conversation.take(message)
                conversation.end_of_call()
            except ClientError as error:
                time.sleep(conversation.pause_s(error, retries))

    def pose_call(
        self, call: Call, exchange: PoseExchange, timeout_s: float | None, reconnect_s: float | None
    ) -> PoseCall:
        """The calls of a stream, one after another.

        They end after `timeout_s` (None: they may last), or when no other call has brought anything for `reconnect_s`
        after one that broke (None: the client's timeout_s).
        """
        retries = Retries(
            None if timeout_s is None else check_timeout(timeout_s),
            self._timeout_s if reconnect_s is None else check_reconnect(reconnect_s),
            longest_pause_s=LONGEST_PAUSE_OF_STREAMS_S,
        )

        def start(*messages: Any) -> Any:
            return call(*messages, timeout=retries.remaining_s(), metadata=metadata_of(exchange, self._api_key))

        return PoseCall(start, exchange, retries, self.address)

    def _retries(self, timeout_s: float | None) -> Retries:
        if timeout_s is None:
            return Retries(None, self._timeout_s)
        return Retries(check_timeout(timeout_s), None)

    def _short_retries(self, timeout_s: float | None) -> Retries:
        return self._retries(self._timeout_s if timeout_s is None else timeout_s)

    def _answer(self, call: Call, content: Callable[[], Any], about: Any, retries: Retries) -> Any:
        """The answer to what `content` gives for each attempt; `about` names the scene, if it is about one."""
        while True:
            metadata = metadata_of(about, self._api_key)
            try:
                with client_errors(self.address):
                    return call(content(), timeout=retries.remaining_s(), metadata=metadata)
            except ClientError as error:
                time.sleep(retries.pause_s(error))

    @contextmanager
    def _streamed(self, call: Call, request: Any, retries: Retries) -> Iterator[Any]:
        """The messages that a call streams; the call ends with the context."""
        messages = call(request, timeout=retries.remaining_s(), metadata=metadata_of(request, self._api_key))
        try:
            with client_errors(self.address):
                yield messages
        finally:
            messages.cancel()
