"""How a client asks the service: what a question is, and the connections that carry it out, for threads and asyncio.
`client.py` describes the operations.

Questions are coroutines over a few steps of a connection. Those of `Connection` block, so that a coroutine never waits
and is through in one go; those of `AsyncConnection` wait in the event loop.
"""

from __future__ import annotations

import asyncio
import inspect
import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Coroutine, Iterator
from contextlib import AbstractContextManager, aclosing
from dataclasses import dataclass, is_dataclass
from functools import cache
from types import MappingProxyType, MethodType
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar, overload

import grpc
from google.protobuf.descriptor import MethodDescriptor
from google.protobuf.descriptor_pool import Default
from google.protobuf.message_factory import GetMessageClass

from ultragray_client.connection import CHANNEL_OPTIONS, ApiKey, Metadata, Retries, Terms, Tls, client_errors
from ultragray_client.conversations import Conversation
from ultragray_client.errors import ClientError, NotFound
from ultragray_client.exchange import PoseExchange
from ultragray_client.frames import received_frame
from ultragray_client.messages import message_of
from ultragray_client.stream import AsyncFrameStream, FrameStream
from ultragray_proto.codec import from_message

P = ParamSpec("P")
T = TypeVar("T")
Now = TypeVar("Now")
Later = TypeVar("Later")
PAGE_SIZE = 1000  # the most that the service gives at once
_READERS = {"Frame": received_frame}  # of messages by name; others are read by protobuf


class Connection(Terms):
    """A channel that threads share. All methods raise ClientError."""

    _grpc: Any = grpc

    def __init__(self, address: str, api_key: ApiKey | None, tls: Tls | None, timeout_s: float) -> None:
        super().__init__(address, api_key, tls, timeout_s)
        if self.tls is None:
            self._channel = self._grpc.insecure_channel(self.address, options=CHANNEL_OPTIONS)
        else:
            self._channel = self._grpc.secure_channel(self.address, self.tls.credentials(), options=self.tls.options())
        self._methods: dict[str, Any] = {}

    def close(self) -> Any:
        """Ends all that is under way."""
        return self._channel.close()

    def method(self, name: str) -> Any:
        """A method over the channel, such as "SceneService.GetScene"."""
        if name not in self._methods:
            method = _described(name)
            words = ("stream" if streams else "unary" for streams in (method.client_streaming, method.server_streaming))
            self._methods[name] = getattr(self._channel, "_".join(words))(
                f"/{method.containing_service.full_name}/{method.name}",
                request_serializer=GetMessageClass(method.input_type).SerializeToString,
                response_deserializer=_READERS.get(method.output_type.name)
                or GetMessageClass(method.output_type).FromString,
            )
        return self._methods[name]

    def answer(self, question: Call[T] | Collection[T]) -> Any:
        """The answer to a question."""
        return _result(question.answer(self))

    def iterate(self, talk: Talk[T]) -> Any:
        """The results of a conversation as its messages come."""
        results = talk.results(self)
        try:
            while True:
                try:
                    result = _result(results.__anext__())
                except StopAsyncIteration:
                    return
                yield result
        finally:
            _result(results.aclose())

    def open(self, poses: PoseStream) -> Any:
        """A stream of poses."""
        retries = self.stream_retries(poses.timeout_s, poses.reconnect_s)

        def start(*messages: Any) -> Any:
            metadata = self.metadata(poses.exchange)
            return self.method(poses.method)(*messages, timeout=retries.remaining_s(), metadata=metadata)

        return self._stream(poses.exchange, start, retries, self.address)

    _stream: Any = FrameStream

    async def attempt(self, method: str, content: Any, timeout_s: float | None, metadata: Metadata) -> Any:
        """The answer to one call; `content` is a message, or an iterator of messages."""
        with client_errors(self.address):
            return self.method(method)(content, timeout=timeout_s, metadata=metadata)

    def content(self, request: Any) -> Any:
        """What a call is given: a message, or an iterator of messages whose making may wait."""
        return request

    async def next_message(self, call: Any) -> Any:
        """The next message of a call whose answer is a stream; None after the last one."""
        return next(call, None)

    async def rest(self, seconds: float) -> None:
        """Waits before the next attempt."""
        time.sleep(seconds)

    async def keep(self, keep: Callable[[T], None], result: T) -> None:
        """Does what may wait for the disk."""
        keep(result)


def _result(coroutine: Any) -> Any:
    """What a coroutine returns that waits for nothing."""
    try:
        coroutine.send(None)
    except StopIteration as end:
        return end.value
    raise AssertionError("a step of a connection for threads waited in an event loop")


class AsyncConnection(Connection):
    """A channel of the running event loop."""

    _grpc = grpc.aio
    _stream = AsyncFrameStream

    def answer(self, question: Call[T] | Collection[T]) -> Any:
        return question.answer(self)

    def iterate(self, talk: Talk[T]) -> Any:
        return talk.results(self)

    async def attempt(self, method: str, content: Any, timeout_s: float | None, metadata: Metadata) -> Any:
        with client_errors(self.address):
            return await self.method(method)(self.content(content), timeout=timeout_s, metadata=metadata)

    def content(self, request: Any) -> Any:
        return _read_in_threads(request) if isinstance(request, Iterator) else request

    async def next_message(self, call: Any) -> Any:
        message = await call.read()
        return None if message is grpc.aio.EOF else message

    async def rest(self, seconds: float) -> None:
        await asyncio.sleep(seconds)

    async def keep(self, keep: Callable[[T], None], result: T) -> None:
        await asyncio.to_thread(keep, result)


async def _read_in_threads(messages: Iterator[T]) -> AsyncIterator[T]:
    """Messages whose making waits, such as for the disk."""
    while (message := await asyncio.to_thread(next, messages, None)) is not None:
        yield message


class Call(Generic[T]):
    """A question with one answer. `timeout_s` is for all attempts together; None: the client's.

    The request has `fields`, and those of `request`, in the form that a caller gives them; `read` makes the answer of
    the message, or is the dataclass that it tells.
    """

    def __init__(
        self,
        method: str,
        read: Callable[[Any], T] | type[T],
        timeout_s: float | None,
        *,
        request: object = MappingProxyType({}),
        **fields: Any,
    ) -> None:
        """Raises InvalidArgument for a word that no message has."""
        self._method, self._timeout_s = method, timeout_s
        self._request = message_of(request, GetMessageClass(_described(method).input_type), **fields)
        self._read = _reading(read)

    async def answer(self, connection: Connection) -> T:
        """The answer that a caller gets."""
        return self._read(await self._ask(connection, connection.retries(self._timeout_s, is_short=True)))

    async def _ask(self, connection: Connection, retries: Retries) -> Any:
        while True:
            metadata = connection.metadata(self._request)
            try:
                return await connection.attempt(self._method, self._content(), retries.remaining_s(), metadata)
            except ClientError as error:
                pause_s = retries.pause_s(error)
            await connection.rest(pause_s)

    def _content(self) -> Any:
        return self._request


class Deletion(Call[None]):
    """A deletion. What is not found any more where an attempt broke off was deleted by that."""

    def __init__(self, method: str, timeout_s: float | None, **fields: Any) -> None:
        super().__init__(method, lambda _: None, timeout_s, **fields)

    async def answer(self, connection: Connection) -> None:
        retries = connection.retries(self._timeout_s, is_short=True)
        try:
            await self._ask(connection, retries)
        except NotFound:
            if not retries.was_unavailable:
                raise


class LongCall(Call[T]):
    """A question that takes as long as the work behind it. No timeout: as long as it takes."""

    async def answer(self, connection: Connection) -> T:
        return self._read(await self._ask(connection, connection.retries(self._timeout_s)))


class Sending(LongCall[T]):
    """Messages that each attempt sends from the first one on, and their answer. No timeout: as long as it takes."""

    def __init__(
        self, method: str, messages: Callable[[], Iterator[Any]], read: Callable[[Any], T], timeout_s: float | None
    ) -> None:
        super().__init__(method, read, timeout_s)
        self._messages = messages

    def _content(self) -> Any:
        return self._messages()


class Listing(Call[tuple[T, ...]]):
    """A list that comes in pages, at most `limit` of its `items`. Each page has the timeout for itself."""

    def __init__(
        self,
        method: str,
        items: str,
        read: Callable[[Any], T] | type[T],
        timeout_s: float | None,
        limit: int | None = None,
        request: object = MappingProxyType({}),
    ) -> None:
        super().__init__(method, each(items, read), timeout_s, request=request)
        self._limit = limit

    async def answer(self, connection: Connection) -> tuple[T, ...]:
        items: tuple[T, ...] = ()
        while self._limit is None or len(items) < self._limit:
            self._request.page_size = PAGE_SIZE if self._limit is None else min(PAGE_SIZE, self._limit - len(items))
            page = await self._ask(connection, connection.retries(self._timeout_s, is_short=True))
            items += self._read(page)
            self._request.page_token = page.next_page_token
            if not page.next_page_token:
                break
        return items


def each(items: str, read: Callable[[Any], T] | type[T]) -> Callable[[Any], tuple[T, ...]]:
    """Reads the messages of a list within a message."""
    read_item = _reading(read)
    return lambda message: tuple(map(read_item, getattr(message, items)))


def _reading(read: Callable[[Any], T] | type[T]) -> Callable[[Any], T]:
    if not is_dataclass(read):
        return read
    cls: Any = read
    return lambda message: from_message(message, cls)


@cache
def _described(method: str) -> MethodDescriptor:
    """The descriptor of a method such as "SceneService.GetScene"."""
    return Default().FindMethodByName(f"ultragray.v1.{method}")


@dataclass(frozen=True)
class Talk(Generic[T]):
    """A conversation over calls of a method whose answers are streams. No timeout: as long as it takes."""

    method: str
    conversation: Conversation[T]
    timeout_s: float | None

    async def results(self, connection: Connection) -> AsyncGenerator[T, None]:
        """What each message means, as they come."""
        retries, conversation = connection.retries(self.timeout_s), self.conversation
        while (request := conversation.request()) is not None:
            try:
                metadata = connection.metadata(request)
                content = connection.content(request)
                call = connection.method(self.method)(content, timeout=retries.remaining_s(), metadata=metadata)
                try:
                    with client_errors(connection.address):
                        while (message := await connection.next_message(call)) is not None:
                            retries.progress()
                            yield conversation.take(message)
                finally:
                    call.cancel()
                conversation.end_of_call()
            except ClientError as error:
                await connection.rest(conversation.pause_s(error, retries))


@dataclass(frozen=True)
class Collection(Generic[T]):
    """A conversation that keeps its results, and makes one answer of them.

    `keeper` begins it, in a context that holds what is made. Beside what a conversation has, it has `keep`, which takes
    a result and may wait for the disk, and `result`.
    """

    method: str
    keeper: Callable[[], AbstractContextManager[Any]]
    timeout_s: float | None

    async def answer(self, connection: Connection) -> T:
        """What was collected."""
        with self.keeper() as keeper:
            async with aclosing(Talk(self.method, keeper, self.timeout_s).results(connection)) as results:
                async for result in results:
                    await connection.keep(keeper.keep, result)
        return keeper.result  # type: ignore[no-any-return]


@dataclass(frozen=True)
class PoseStream:
    """A stream of poses, which lasts at most `timeout_s`, and goes on after a failure for at most `reconnect_s`."""

    method: str
    exchange: PoseExchange
    timeout_s: float | None
    reconnect_s: float | None


# Operations of a client: methods that describe a question, and do what the connection of their object does with it.


AnyConnection = TypeVar("AnyConnection", Connection, AsyncConnection)

# By the type that a description gives: the method of the connection, and what it returns for threads and for asyncio.
_VERBS = {
    "Talk": ("iterate", "Iterator[{}]", "AsyncIterator[{}]"),
    "PoseStream": ("open", "FrameStream", "AsyncFrameStream"),
    "Listing": ("answer", "tuple[{}, ...]", "tuple[{}, ...]"),
}


class Group(Generic[AnyConnection]):
    """Operations that go over the connection of a client."""

    is_async = False  # what the class itself shows

    def __init__(self, connection: AnyConnection) -> None:
        self._connection: AnyConnection = connection


class Operation(Generic[P, Now, Later]):
    """A method of a `Group` with the name, the parameters and the docstring of its description."""

    def __init__(self, describe: Callable[..., Any]) -> None:
        signature = inspect.signature(describe)
        kind, _, inner = str(signature.return_annotation).removesuffix("]").partition("[")
        verb, *answers = _VERBS.get(kind, ("answer", "{}", "{}"))

        def at_once(group: Any, *arguments: Any, **keywords: Any) -> Any:
            return getattr(group._connection, verb)(describe(group, *arguments, **keywords))

        async def in_time(group: Any, *arguments: Any, **keywords: Any) -> Any:
            return await at_once(group, *arguments, **keywords)

        def of_asyncio(group: Any, *arguments: Any, **keywords: Any) -> Any:
            return at_once(group, *arguments, **keywords)

        self._methods: tuple[Any, Any] = at_once, in_time if verb == "answer" else of_asyncio
        method: Any
        for method, answer in zip(self._methods, answers, strict=True):
            method.__signature__ = signature.replace(return_annotation=answer.format(inner))
            method.__name__, method.__qualname__ = describe.__name__, describe.__qualname__
            method.__doc__ = describe.__doc__

    @overload
    def __get__(self, group: Group[Connection], owner: Any) -> Callable[P, Now]: ...
    @overload
    def __get__(self, group: Group[AsyncConnection], owner: Any) -> Callable[P, Later]: ...
    def __get__(self, group: Any, owner: Any) -> Any:
        if group is None:
            return self._methods[owner.is_async]
        return MethodType(self._methods[isinstance(group._connection, AsyncConnection)], group)


@overload
def operation(
    describe: Callable[Concatenate[Any, P], Call[T] | Collection[T]],
) -> Operation[P, T, Coroutine[Any, Any, T]]: ...
@overload
def operation(describe: Callable[Concatenate[Any, P], Talk[T]]) -> Operation[P, Iterator[T], AsyncIterator[T]]: ...
@overload
def operation(describe: Callable[Concatenate[Any, P], PoseStream]) -> Operation[P, FrameStream, AsyncFrameStream]: ...
def operation(describe: Any) -> Any:
    """The method of a client that a description of its question makes."""
    return Operation(describe)
