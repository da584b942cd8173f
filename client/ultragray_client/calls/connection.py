"""Options of a connection, and calls that go on where they broke off."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Generic, TypeAlias, TypeVar
from urllib.parse import quote

from ..errors import ClientError, InvalidArgument
from .retries import Retries

T = TypeVar("T")
ApiKey: TypeAlias = str | Callable[[], str]  # of which the function gives one that is valid when it is called

DEFAULT_ADDRESS = "localhost:50051"
DEFAULT_TIMEOUT_S = 30.0
LONGEST_PAUSE_OF_STREAMS_S = 1.0  # between attempts to go on: a control loop waits
PAGE_SIZE = 1000  # the most that the service gives at once
CHANNEL_OPTIONS: tuple[tuple[str, str | int], ...] = (
    ("grpc.max_receive_message_length", -1),  # a frame of float32 outputs may be larger than the usual 4 MiB
    ("grpc.keepalive_time_ms", 30_000),  # only while calls are under way; a peer that vanished is noticed
    ("grpc.keepalive_timeout_ms", 10_000),
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 2_000),
)
SCENE_KEY = "x-ultragray-scene"
Metadata: TypeAlias = tuple[tuple[str, str], ...]


def metadata_of(request: Any, api_key: ApiKey | None) -> Metadata:
    """The metadata of a call: the key, and the scene that the request names, by which a proxy sends the calls of one
    scene to the same replica.

    `request`: a message, or anything else with the same `scene` or `settings.scene`.
    """
    scene = getattr(getattr(request, "settings", request), "scene", "")
    metadata: Metadata = ((SCENE_KEY, quote(scene, safe="")),) if scene else ()
    if api_key is None:
        return metadata
    return (*metadata, ("x-api-key", api_key if isinstance(api_key, str) else api_key()))


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


def check_reconnect(reconnect_s: float) -> float:
    """Raises InvalidArgument for less than 0."""
    if not reconnect_s >= 0.0:
        raise InvalidArgument(f"reconnect_s must be at least 0, got {reconnect_s:g}", field="reconnect_s")
    return reconnect_s
