"""What both clients share of a connection: its options, the stubs, and calls as values."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Generic, TypeVar

from ultragray_proto.v1 import datasets_pb2_grpc, jobs_pb2_grpc, rendering_pb2_grpc, scenes_pb2_grpc

from .errors import ClientError, InvalidArgument, NotFound
from .retries import Retries

T = TypeVar("T")

DEFAULT_ADDRESS = "localhost:50051"
DEFAULT_TIMEOUT_S = 30.0
CHANNEL_OPTIONS = (
    ("grpc.max_receive_message_length", -1),  # a frame of float32 outputs may be larger than the usual 4 MiB
    ("grpc.keepalive_time_ms", 30_000),  # only while calls are under way; a peer that vanished is noticed
    ("grpc.keepalive_timeout_ms", 10_000),
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 2_000),
)


class Stubs:
    """The four services over one channel, sync or asyncio."""

    def __init__(self, channel: Any) -> None:
        self.scenes = scenes_pb2_grpc.SceneServiceStub(channel)
        self.rendering = rendering_pb2_grpc.RenderServiceStub(channel)
        self.datasets = datasets_pb2_grpc.DatasetServiceStub(channel)
        self.jobs = jobs_pb2_grpc.JobServiceStub(channel)

    def method(self, path: str) -> Any:
        """The method to call, such as "scenes.GetScene"."""
        return attrgetter(path)(self)


@dataclass(frozen=True)
class Operation(Generic[T]):
    """A call with one answer: its method ("scenes.GetScene"), its request, and what the answer means."""

    method: str
    request: Any
    convert: Callable[[Any], T]
    deletes: bool = False  # then NOT_FOUND after a connection that broke means that it worked


class Conversation(ABC, Generic[T]):
    """A call that streams its answers. Where it breaks off, another one asks for what is missing."""

    method: str  # such as "jobs.WatchJob"

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


@dataclass
class Pages(Generic[T]):
    """A list that comes in pages, at most `limit` items of it."""

    operation: Callable[[int, str], Operation[tuple[list[T], str]]]  # of a page's size and token
    limit: int | None

    def __post_init__(self) -> None:
        self.items: list[T] = []
        self._token: str | None = ""

    def operations(self) -> Iterator[Operation[tuple[list[T], str]]]:
        """What to ask next, until all is there; each answer goes to `take`."""
        while self._token is not None and (self.limit is None or len(self.items) < self.limit):
            size = 1000 if self.limit is None else min(1000, self.limit - len(self.items))
            yield self.operation(size, self._token)

    def take(self, page: tuple[list[T], str]) -> None:
        self.items += page[0]
        self._token = page[1] or None


def call_metadata(api_key: str | None) -> tuple[tuple[str, str], ...]:
    """What every call carries."""
    return () if api_key is None else (("x-api-key", api_key),)


def check_timeout(timeout_s: float) -> float:
    """Raises InvalidArgument unless above 0."""
    if not timeout_s > 0.0:
        raise InvalidArgument(f"timeout_s must be above 0, got {timeout_s:g}", field="timeout_s")
    return timeout_s


def is_done(operation: Operation[Any], error: Exception, broke: bool) -> bool:
    """Whether the failure of a repeated deletion says that the attempt before, which broke off, had worked."""
    return operation.deletes and broke and isinstance(error, NotFound)
