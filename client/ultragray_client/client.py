"""The clients, for threads and for asyncio side by side: thin transports of the calls that `calls.py` describes.

A method of a client is such a description carried out: `render = answer_method(ClientCalls.render)` has the parameters
and the docstring of the description, and gives what the call answers.
"""

from __future__ import annotations

import asyncio
import inspect
import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Coroutine, Generator, Iterator
from contextlib import aclosing, closing
from typing import Any, Concatenate, ParamSpec, TypeVar

import grpc

from ultragray_client.calls import (
    Attempt,
    Call,
    ClientCalls,
    Collection,
    DatasetCalls,
    JobCalls,
    Listing,
    Pause,
    PoseStream,
    RegistrationCalls,
    SceneCalls,
    Talk,
    WorkerCalls,
)
from ultragray_client.connection import (
    CHANNEL_OPTIONS,
    DEFAULT_ADDRESS,
    DEFAULT_TIMEOUT_S,
    ApiKey,
    Terms,
    Tls,
    client_errors,
    error_of_call,
)
from ultragray_client.errors import ClientError
from ultragray_client.stream import AsyncFrameStream, FrameStream
from ultragray_proto.v1 import (
    access_pb2_grpc,
    datasets_pb2_grpc,
    jobs_pb2_grpc,
    registrations_pb2_grpc,
    rendering_pb2_grpc,
    scenes_pb2_grpc,
    workers_pb2_grpc,
)

P = ParamSpec("P")
T = TypeVar("T")

_STUBS: tuple[Callable[[Any], Any], ...] = (
    access_pb2_grpc.AccessServiceStub,
    datasets_pb2_grpc.DatasetServiceStub,
    jobs_pb2_grpc.JobServiceStub,
    registrations_pb2_grpc.RegistrationServiceStub,
    rendering_pb2_grpc.RenderServiceStub,
    scenes_pb2_grpc.SceneServiceStub,
    workers_pb2_grpc.WorkerServiceStub,
)


def _methods(channel: Any) -> dict[str, Any]:
    """The methods of all services over a channel, by names such as "SceneService.GetScene"."""
    stubs = {stub.__name__.removesuffix("Stub"): vars(stub(channel)) for stub in _STUBS}
    return {f"{service}.{name}": method for service, methods in stubs.items() for name, method in methods.items()}


class Connection(Terms):
    """A channel that threads share. All methods raise ClientError."""

    def __init__(self, address: str, api_key: ApiKey | None, tls: Tls | None, timeout_s: float) -> None:
        super().__init__(address, api_key, tls, timeout_s)
        if tls is None:
            self._channel = grpc.insecure_channel(address, options=CHANNEL_OPTIONS)
        else:
            self._channel = grpc.secure_channel(address, tls.credentials(), options=tls.options())
        self._methods = _methods(self._channel)

    def close(self) -> None:
        self._channel.close()

    def answer(self, call: Call[T] | Collection[T]) -> T:
        """The answer to a call, or what a conversation is collected to."""
        if isinstance(call, Collection):
            return self._collect(call)
        steps, answer = call.steps(self), None
        try:
            step = next(steps)
            while True:
                failure = None
                try:
                    answer = self._carry_out(step)
                except grpc.RpcError as error:
                    failure = error_of_call(error, self.address)
                step = steps.send(answer) if failure is None else steps.throw(failure)
        except StopIteration as end:
            return end.value  # type: ignore[no-any-return]

    def _carry_out(self, step: Attempt | Pause) -> Any:
        if isinstance(step, Pause):
            return time.sleep(step.seconds)
        return self._methods[step.method](step.content, timeout=step.timeout_s, metadata=step.metadata)

    def iterate(self, talk: Talk[T]) -> Generator[T, None, None]:
        """The results of a conversation as its messages come."""
        retries, conversation = self.retries(talk.timeout_s), talk.conversation
        while (request := conversation.request()) is not None:
            try:
                messages = self._methods[talk.method](
                    request, timeout=retries.remaining_s(), metadata=self.metadata(request)
                )
                try:
                    with client_errors(self.address):
                        for message in messages:
                            retries.progress()
                            yield conversation.take(message)
                finally:
                    messages.cancel()
                conversation.end_of_call()
            except ClientError as error:
                time.sleep(conversation.pause_s(error, retries))

    def _collect(self, work: Collection[T]) -> T:
        with work.keeper() as keeper, closing(self.iterate(Talk(work.method, keeper, work.timeout_s))) as items:
            for item in items:
                keeper.keep(item)
        return keeper.result  # type: ignore[no-any-return]

    def open(self, poses: PoseStream) -> FrameStream:
        """A stream of poses."""
        retries = self.stream_retries(poses.timeout_s, poses.reconnect_s)

        def start(messages: Iterator[Any]) -> Any:
            metadata = self.metadata(poses.exchange)
            return self._methods[poses.method](messages, timeout=retries.remaining_s(), metadata=metadata)

        return FrameStream(poses.exchange, start, retries, self.address)


class AsyncConnection(Terms):
    """A channel of the running event loop. All methods raise ClientError."""

    def __init__(self, address: str, api_key: ApiKey | None, tls: Tls | None, timeout_s: float) -> None:
        super().__init__(address, api_key, tls, timeout_s)
        if tls is None:
            self._channel = grpc.aio.insecure_channel(address, options=CHANNEL_OPTIONS)
        else:
            self._channel = grpc.aio.secure_channel(address, tls.credentials(), options=tls.options())
        self._methods = _methods(self._channel)

    async def close(self) -> None:
        await self._channel.close()

    async def answer(self, call: Call[T] | Collection[T]) -> T:
        """The answer to a call, or what a conversation is collected to."""
        if isinstance(call, Collection):
            return await self._collect(call)
        steps, answer = call.steps(self), None
        try:
            step = next(steps)
            while True:
                failure = None
                try:
                    answer = await self._carry_out(step)
                except grpc.RpcError as error:
                    failure = error_of_call(error, self.address)
                step = steps.send(answer) if failure is None else steps.throw(failure)
        except StopIteration as end:
            return end.value  # type: ignore[no-any-return]

    async def _carry_out(self, step: Attempt | Pause) -> Any:
        if isinstance(step, Pause):
            return await asyncio.sleep(step.seconds)
        content = _read_in_threads(step.content) if isinstance(step.content, Iterator) else step.content
        return await self._methods[step.method](content, timeout=step.timeout_s, metadata=step.metadata)

    async def iterate(self, talk: Talk[T]) -> AsyncGenerator[T, None]:
        """The results of a conversation as its messages come."""
        retries, conversation = self.retries(talk.timeout_s), talk.conversation
        while (request := conversation.request()) is not None:
            try:
                messages = self._methods[talk.method](
                    request, timeout=retries.remaining_s(), metadata=self.metadata(request)
                )
                try:
                    with client_errors(self.address):
                        async for message in messages:
                            retries.progress()
                            yield conversation.take(message)
                finally:
                    messages.cancel()
                conversation.end_of_call()
            except ClientError as error:
                await asyncio.sleep(conversation.pause_s(error, retries))

    async def _collect(self, work: Collection[T]) -> T:
        with work.keeper() as keeper:
            async with aclosing(self.iterate(Talk(work.method, keeper, work.timeout_s))) as items:
                async for item in items:
                    await asyncio.to_thread(keeper.keep, item)
        return keeper.result  # type: ignore[no-any-return]

    def open(self, poses: PoseStream) -> AsyncFrameStream:
        """A stream of poses."""
        retries = self.stream_retries(poses.timeout_s, poses.reconnect_s)

        def start() -> Any:
            metadata = self.metadata(poses.exchange)
            return self._methods[poses.method](timeout=retries.remaining_s(), metadata=metadata)

        return AsyncFrameStream(poses.exchange, start, retries, self.address)


async def _read_in_threads(messages: Iterator[T]) -> AsyncIterator[T]:
    """Messages whose making waits for the disk."""
    while (message := await asyncio.to_thread(next, messages, None)) is not None:
        yield message


def _method(describe: Callable[..., Any], verb: str, answer: str, *, is_awaited: bool = False) -> Any:
    """A method of a client that does `verb` of its connection with what `describe` gives.

    It has the name, the parameters and the docstring of the description. `answer` is what it returns, {} for the type
    that the description has in brackets.
    """

    def at_once(self: Any, *arguments: Any, **keywords: Any) -> Any:
        return getattr(self._connection, verb)(describe(*arguments, **keywords))

    async def in_time(self: Any, *arguments: Any, **keywords: Any) -> Any:
        return await at_once(self, *arguments, **keywords)

    method: Any = in_time if is_awaited else at_once
    signature = inspect.signature(describe)
    kind, _, inner = str(signature.return_annotation).removesuffix("]").partition("[")
    if kind == Listing.__name__:
        inner = f"tuple[{inner}, ...]"
    own = inspect.Parameter("self", inspect.Parameter.POSITIONAL_OR_KEYWORD)
    method.__signature__ = signature.replace(
        parameters=[own, *signature.parameters.values()], return_annotation=answer.format(inner)
    )
    method.__name__, method.__qualname__ = describe.__name__, describe.__qualname__.replace("Calls", "")
    method.__doc__ = describe.__doc__
    return method


def answer_method(describe: Callable[P, Call[T] | Collection[T]]) -> Callable[Concatenate[Any, P], T]:
    """The method that waits for the answer to a call."""
    return _method(describe, "answer", "{}")  # type: ignore[no-any-return]


def iterator_method(describe: Callable[P, Talk[T]]) -> Callable[Concatenate[Any, P], Iterator[T]]:
    """The method that gives the results of a conversation as they come."""
    return _method(describe, "iterate", "Iterator[{}]")  # type: ignore[no-any-return]


def stream_method(describe: Callable[P, PoseStream]) -> Callable[Concatenate[Any, P], FrameStream]:
    """The method that opens a stream of poses."""
    return _method(describe, "open", "FrameStream")  # type: ignore[no-any-return]


def coroutine_method(
    describe: Callable[P, Call[T] | Collection[T]],
) -> Callable[Concatenate[Any, P], Coroutine[Any, Any, T]]:
    """As `answer_method`, for asyncio."""
    return _method(describe, "answer", "{}", is_awaited=True)  # type: ignore[no-any-return]


def async_iterator_method(describe: Callable[P, Talk[T]]) -> Callable[Concatenate[Any, P], AsyncIterator[T]]:
    """As `iterator_method`, for asyncio."""
    return _method(describe, "iterate", "AsyncIterator[{}]")  # type: ignore[no-any-return]


def async_stream_method(describe: Callable[P, PoseStream]) -> Callable[Concatenate[Any, P], AsyncFrameStream]:
    """As `stream_method`, for asyncio."""
    return _method(describe, "open", "AsyncFrameStream")  # type: ignore[no-any-return]


class _Group:
    """Operations that go over the connection of a client."""

    def __init__(self, connection: Connection | AsyncConnection) -> None:
        self._connection = connection


class Scenes(_Group):
    """`client.scenes`. All raise ClientError; a name that does not exist is SceneNotFound."""

    list = answer_method(SceneCalls.list)
    get = answer_method(SceneCalls.get)
    load = answer_method(SceneCalls.load)
    unload = answer_method(SceneCalls.unload)


class Datasets(_Group):
    """`client.datasets`. All raise ClientError; a name that does not exist is DatasetNotFound."""

    upload = answer_method(DatasetCalls.upload)
    list = answer_method(DatasetCalls.list)
    get = answer_method(DatasetCalls.get)
    contact_sheet = answer_method(DatasetCalls.contact_sheet)
    delete = answer_method(DatasetCalls.delete)


class Jobs(_Group):
    """`client.jobs`. All raise ClientError; an id that does not exist is JobNotFound.

    A submission has a `request_id`, one of its own unless one is given: the same id with the same job gives the job
    that is there, with another one RequestIdConflict. A `priority` is from -1000 to 1000, higher ones go first. Others
    see neither a `private` job nor the scene that it makes.
    """

    submit = answer_method(JobCalls.submit)
    list = answer_method(JobCalls.list)
    get = answer_method(JobCalls.get)
    watch = iterator_method(JobCalls.watch)
    wait = answer_method(JobCalls.wait)
    cancel = answer_method(JobCalls.cancel)
    retry = answer_method(JobCalls.retry)
    delete = answer_method(JobCalls.delete)
    log = answer_method(JobCalls.log)
    download = answer_method(JobCalls.download)


class Workers(_Group):
    """`client.workers`. All raise ClientError; a name that does not exist is WorkerNotFound.

    Only admins pause, drain and resume; the worker obeys within two seconds, and rests until `resume`, restarts
    included.
    """

    list = answer_method(WorkerCalls.list)
    pause = answer_method(WorkerCalls.pause)
    drain = answer_method(WorkerCalls.drain)
    resume = answer_method(WorkerCalls.resume)


class Registrations(_Group):
    """`client.registrations`. All raise ClientError; a name that does not exist is RegistrationNotFound."""

    list = answer_method(RegistrationCalls.list)
    get = answer_method(RegistrationCalls.get)
    put = answer_method(RegistrationCalls.put)
    delete = answer_method(RegistrationCalls.delete)


class Client:
    """A service at `address` (HOST:PORT), encrypted where `tls` is given.

    `api_key` is a key or a token that the service knows, or a function that is called before each call and gives one
    that is valid then, at once: a token that will soon expire is best renewed elsewhere.

    Threads may share a `Client`; each process needs one of its own, made after the fork. An `AsyncClient` is made and
    used within one event loop.

    `timeout_s` is the deadline of each call that names none, all its attempts together. Calls that go on for as long
    as they take (`render_batch`, `jobs.watch`, up- and downloads) ask a service that fails without any progress again
    for so long. A call is repeated where the service was not reached, is starting or stopping, or has a full queue,
    after the delay that it tells; nothing else is.
    """

    def __init__(
        self,
        address: str = DEFAULT_ADDRESS,
        *,
        api_key: ApiKey | None = None,
        tls: Tls | None = None,
        timeout_s: float = DEFAULT_TIMEOUT_S,
    ) -> None:
        self._connection = Connection(address, api_key, tls, timeout_s)
        self.scenes = Scenes(self._connection)
        self.datasets = Datasets(self._connection)
        self.jobs = Jobs(self._connection)
        self.workers = Workers(self._connection)
        self.registrations = Registrations(self._connection)

    render = answer_method(ClientCalls.render)
    render_batch = iterator_method(ClientCalls.render_batch)
    stream = stream_method(ClientCalls.stream)
    render_slice = answer_method(ClientCalls.render_slice)
    assess_poses = answer_method(ClientCalls.assess_poses)
    localize = answer_method(ClientCalls.localize)
    who_am_i = answer_method(ClientCalls.who_am_i)
    audit = answer_method(ClientCalls.audit)

    def close(self) -> None:
        """Ends all that is under way."""
        self._connection.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class AsyncScenes(_Group):
    """`Scenes` for asyncio."""

    list = coroutine_method(SceneCalls.list)
    get = coroutine_method(SceneCalls.get)
    load = coroutine_method(SceneCalls.load)
    unload = coroutine_method(SceneCalls.unload)


class AsyncDatasets(_Group):
    """`Datasets` for asyncio."""

    upload = coroutine_method(DatasetCalls.upload)
    list = coroutine_method(DatasetCalls.list)
    get = coroutine_method(DatasetCalls.get)
    contact_sheet = coroutine_method(DatasetCalls.contact_sheet)
    delete = coroutine_method(DatasetCalls.delete)


class AsyncJobs(_Group):
    """`Jobs` for asyncio."""

    submit = coroutine_method(JobCalls.submit)
    list = coroutine_method(JobCalls.list)
    get = coroutine_method(JobCalls.get)
    watch = async_iterator_method(JobCalls.watch)
    wait = coroutine_method(JobCalls.wait)
    cancel = coroutine_method(JobCalls.cancel)
    retry = coroutine_method(JobCalls.retry)
    delete = coroutine_method(JobCalls.delete)
    log = coroutine_method(JobCalls.log)
    download = coroutine_method(JobCalls.download)


class AsyncWorkers(_Group):
    """`Workers` for asyncio."""

    list = coroutine_method(WorkerCalls.list)
    pause = coroutine_method(WorkerCalls.pause)
    drain = coroutine_method(WorkerCalls.drain)
    resume = coroutine_method(WorkerCalls.resume)


class AsyncRegistrations(_Group):
    """`Registrations` for asyncio."""

    list = coroutine_method(RegistrationCalls.list)
    get = coroutine_method(RegistrationCalls.get)
    put = coroutine_method(RegistrationCalls.put)
    delete = coroutine_method(RegistrationCalls.delete)


class AsyncClient:
    """`Client` for asyncio, with the same methods, to be awaited or iterated with `async for`.

    It is made and used within one event loop: `async with AsyncClient() as client: frame = await client.render(…)`.
    """

    def __init__(
        self,
        address: str = DEFAULT_ADDRESS,
        *,
        api_key: ApiKey | None = None,
        tls: Tls | None = None,
        timeout_s: float = DEFAULT_TIMEOUT_S,
    ) -> None:
        self._connection = AsyncConnection(address, api_key, tls, timeout_s)
        self.scenes = AsyncScenes(self._connection)
        self.datasets = AsyncDatasets(self._connection)
        self.jobs = AsyncJobs(self._connection)
        self.workers = AsyncWorkers(self._connection)
        self.registrations = AsyncRegistrations(self._connection)

    render = coroutine_method(ClientCalls.render)
    render_batch = async_iterator_method(ClientCalls.render_batch)
    stream = async_stream_method(ClientCalls.stream)
    render_slice = coroutine_method(ClientCalls.render_slice)
    assess_poses = coroutine_method(ClientCalls.assess_poses)
    localize = coroutine_method(ClientCalls.localize)
    who_am_i = coroutine_method(ClientCalls.who_am_i)
    audit = coroutine_method(ClientCalls.audit)

    async def close(self) -> None:
        """Ends all that is under way."""
        await self._connection.close()

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()
