"""Options of a connection, and calls that go on where they broke off."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Generic, TypeAlias, TypeVar

from ..errors import ClientError, InvalidArgument
from .retries import Retries

T = TypeVar("T")
ApiKey: TypeAlias = str | Callable[[], str]  # of which the function gives one that is valid when it is called

DEFAULT_ADDRESS = "localhost:50051"
DEFAULT_TIMEOUT_S = 30.0
PAGE_SIZE = 1000  # the most that the service gives at once
CHANNEL_OPTIONS: tuple[tuple[str, str | int], ...] = (
    ("grpc.max_receive_message_length", -1),  # a frame of float32 outputs may be larger than the usual 4 MiB
    ("grpc.keepalive_time_ms", 30_000),  # only while calls are under way; a peer that vanished is noticed
    ("grpc.keepalive_timeout_ms", 10_000),
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 2_000),
)


class Conversation(ABC, Generic[T]):
    """Calls whose answers are streams: where one breaks off, the next asks for what is missing."""

    @abstractmethod
    def request(self) -> Any:
        """The request of the next call; None when all is there."""

    @abstractmethod
    def take(self, message: Any) -> T:
        """The meaning of a message."""

    @abstractmethod
    def end_of_call(self) -> None:
        """Notes that the service ended a call without an error. Raises ClientError where it should have gone on."""

    def pause_s(self, error: ClientError, retries: Retries) -> float:
        """The seconds to wait before the next call. Raises the error where no other call can succeed."""
        return retries.pause_s(error)


def check_timeout(timeout_s: float) -> float:
    """Raises InvalidArgument unless above 0."""
    if not timeout_s > 0.0:
        raise InvalidArgument(f"timeout_s must be above 0, got {timeout_s:g}", field="timeout_s")
    return timeout_s
