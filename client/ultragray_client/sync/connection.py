"""Calls over a channel, asked again where that may help."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from typing import Any, TypeVar

import grpc

from ..connection import CHANNEL_OPTIONS, Operation, Pages, Stubs, call_metadata, check_timeout, is_done
from ..errors import Unavailable
from ..retries import Retries
from ..statuses import error_of_call

T = TypeVar("T")


class Connection:
    """A channel and what goes with every call."""

    def __init__(self, address: str, api_key: str | None, timeout_s: float) -> None:
        self.address = address
        self.timeout_s = check_timeout(timeout_s)
        self.metadata = call_metadata(api_key)
        self._channel = grpc.insecure_channel(address, options=CHANNEL_OPTIONS)
        self.stubs = Stubs(self._channel)

    def close(self) -> None:
        self._channel.close()

    def retries(self, timeout_s: float | None) -> Retries:
        """Of a call that may go on for as long as it takes, unless `timeout_s` is given."""
        return Retries(None if timeout_s is None else check_timeout(timeout_s), self.timeout_s)

    def run(self, operation: Operation[T], timeout_s: float | None) -> T | None:
        """The answer. Raises ClientError."""
        retries = self.retries(self.timeout_s if timeout_s is None else timeout_s)
        broke = False
        while True:
            try:
                answer = operation.of(self.stubs)(
                    operation.request, timeout=retries.remaining_s(), metadata=self.metadata
                )
            except grpc.RpcError as failure:
                error = error_of_call(failure, self.address)
                if is_done(operation, error, broke):
                    return None
                broke |= isinstance(error, Unavailable)
                time.sleep(retries.pause_s(error))
            else:
                return operation.convert(answer)

    def answer(self, operation: Operation[T], timeout_s: float | None) -> T:
        """The answer of an operation that always has one. Raises ClientError."""
        answer = self.run(operation, timeout_s)
        assert answer is not None
        return answer

    def all_pages(self, pages: Pages[T], timeout_s: float | None) -> tuple[T, ...]:
        """Raises ClientError."""
        for operation in pages.operations():
            pages.take(self.answer(operation, timeout_s))
        return tuple(pages.items)

    def messages(self, start: Callable[..., Any], request: Any, retries: Retries) -> Generator[Any, None, None]:
        """What a call streams; the call ends with the iteration. Raises ClientError."""
        call = start(request, timeout=retries.remaining_s(), metadata=self.metadata)
        try:
            while (message := _next(call, self.address)) is not None:
                yield message
        finally:
            call.cancel()


def _next(call: Any, address: str) -> Any:
    try:
        return next(call, None)
    except grpc.RpcError as failure:
        raise error_of_call(failure, address) from None
