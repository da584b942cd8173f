"""A stream of poses and frames over the calls of gRPC, for threads and for asyncio.

What both share, in `_PoseStream`, is which poses have no answer yet, and what a call that follows a broken one begins
with. They differ in who waits: in `FrameStream` threads, on one condition; in `AsyncFrameStream` tasks.
"""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from functools import partial
from typing import Any

import grpc
import numpy.typing as npt

from ultragray_client.connection import Retries, error_of_call
from ultragray_client.errors import ClientError, StreamEnded
from ultragray_client.exchange import (
    MAX_WAITING,
    TAKES_NO_MORE,
    Answer,
    NewestAnswers,
    PoseExchange,
    StreamMode,
    Unanswered,
)
from ultragray_client.frames import Frame
from ultragray_client.geometry import PoseLike
from ultragray_client.local import AsyncLocalCall, LocalCall
from ultragray_client.messages import ReceivedFrame

Start = Callable[..., Any]  # a call of RenderStream


class _PoseStream:
    """The calls of a stream, one after another: poses out, frames in. All raise ClientError where none can follow.

    A call that broke is followed by another when the next answer is asked for; meanwhile poses wait. Of a latest stream
    answers are taken as they come; each is acknowledged when the caller takes it.
    """

    def __init__(self, exchange: PoseExchange, start: Start, retries: Retries, address: str) -> None:
        self._exchange, self._start, self._retries, self._address = exchange, start, retries, address
        self._is_latest = exchange.mode is StreamMode.LATEST
        self._unanswered = Unanswered(newest_alone=self._is_latest, goes_on=retries.may_go_on)
        self._unsent: deque[Any] = deque()  # of the call that is open
        self._answers = NewestAnswers()  # of a latest stream
        self._closed = False  # no more poses come
        self._failure: ClientError | None = None  # that ended the stream
        self._is_resumed = False  # the call that is open has brought nothing yet, and is not the first one
        self._reconnections = 0
        self._taken: int | None = None  # the sequence of the answer to be acknowledged; it can wait for the next pose
        self._lost = 0  # poses since the last frame that get none: lost with a connection, or replaced here

    @property
    def reconnections(self) -> int:
        """How often frames went on over another connection."""
        return self._reconnections

    def _begin_call(self) -> Any:
        """The opening of a call; with it all poses that have no answer wait to be sent."""
        opening, self._taken = self._exchange.opening(), None
        self._unsent = deque([opening, *self._unanswered.again()])
        self._lost += self._unanswered.take_lost()
        return opening

    def _resume(self, *, without_memory: bool) -> None:
        """Another call is opened now, for the poses that have no answer."""
        if without_memory:
            self._exchange.give_up_memory()
        else:
            self._is_resumed = True

    def _accepted(self, received: ReceivedFrame) -> Answer | None:
        """The answer that a message is; None: of a service that stops, and refused the pose."""
        if not self._unanswered.answered(received.message):
            return None
        self._retries.progress()
        self._reconnections += self._is_resumed
        self._is_resumed = False
        return self._exchange.arrived(received)

    def _frame(self, answer: Answer | None) -> Frame:
        """The frame of an answer; raises the error in its place, and StreamEnded where there is no answer."""
        if answer is None:
            raise StreamEnded("the stream is over")
        return self._exchange.frame(answer, self._take_lost())

    def _take_acknowledgement(self) -> int | None:
        taken, self._taken = self._taken, None
        return taken

    def _take_lost(self) -> int:
        lost, self._lost = self._lost, 0
        return lost + self._answers.take_skipped()


class FrameStream(_PoseStream):
    """Poses in, frames out; sending and receiving may go on side by side. Leaving it as a context ends it.

    Poses wait in a bounded queue for the thread of the connection. In an ordered stream a full queue makes the sender
    wait; in a latest one the newest pose takes the place of one that waits, and a thread takes answers as they come.
    """

    def __init__(self, exchange: PoseExchange, start: Start, retries: Retries, address: str) -> None:
        super().__init__(exchange, start, retries, address)
        self._changed = threading.Condition()  # all below and in the base is read and written under it
        self._opening: Any = None
        self._cancelled = False
        self._real: Any = None  # the newest real frame, likewise
        self._over = False  # no more answers come
        self._is_sending = False  # the thread of the connection has a message in hand
        self._open()
        if self._is_latest:
            threading.Thread(target=self._take_answers, name="ultragray-stream", daemon=True).start()

    def send(self, pose: PoseLike, *, timeout_s: float | None = None, measured_ns: int | None = None) -> int:
        """Sends a pose ([4, 4] mm, or a Placement) and returns the sequence that its frame will carry, from 1.

        `timeout_s`: later than that the pose is not rendered, and `receive` raises DeadlineExceeded in place of its
        frame. `measured_ns`: when the pose was measured, of `time.monotonic_ns()` (default: now); the frame's
        `latency_ms` counts from it. Raises InvalidPose, StreamEnded, and what ended the stream.
        """
        message = self._exchange.pose(pose, timeout_s, measured_ns)
        with self._changed:
            while not self._closed and not self._is_latest and len(self._unsent) >= MAX_WAITING:
                self._changed.wait()
            if self._failure is not None:
                raise self._failure
            if self._closed:
                raise StreamEnded(TAKES_NO_MORE)
            if self._is_latest and self._unsent and self._unsent[-1] is not self._opening:
                self._unsent.pop()
                self._unanswered.replaced()
                self._lost += 1
            self._unanswered.add(message)
            if not self._is_sent_at_once(message):
                self._unsent.append(message)
                self._changed.notify_all()
        return int(message.sequence)

    def _is_sent_at_once(self, message: Any) -> bool:
        """Sends a pose where nothing is to go before it and nobody has to wait: the thread takes longer to wake up."""
        if self._unsent or self._real or self._is_sending or not isinstance(self._call, LocalCall):
            return False
        if not self._call.send_at_once(self._exchange.departing(message, self._taken)):
            return False
        self._taken = None
        return True

    def send_real(self, image: npt.ArrayLike | bytes, measured_ns: int) -> None:
        """Sends a frame of the real probe that has come, late: frames are corrected by it, and tell so in `preview`.

        `image`: a PNG file or grey values [H, W], uint8 or floats of 0 to 1, rows along depth, columns across scan
        lines, not scan-converted. `measured_ns`: when it was taken, by the clock of the poses', between two of them. A
        newer one takes the place of one that waits here. Raises InvalidArgument; what the service refuses is told as
        refused settings are.
        """
        message = self._exchange.real(image, measured_ns)
        with self._changed:
            self._real = message
            self._changed.notify_all()

    def done_sending(self) -> None:
        """No more poses come; the frames of those that were sent still do, then the iteration ends."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def receive(self) -> Frame:
        """Waits for the next frame; of a latest stream the newest: those it takes the place of are dropped.

        Raises the ClientError that is told in its place, with the `sequence` of its pose: the stream goes on. Raises
        StreamEnded after the last frame, and what ended the stream, such as Unreachable where it could not go on.
        """
        answer = self._newest() if self._is_latest else self._next()
        with self._changed:
            return self._frame(answer)

    def __iter__(self) -> Iterator[Frame]:
        return self

    def __next__(self) -> Frame:
        try:
            return self.receive()
        except StreamEnded:
            raise StopIteration from None

    def __enter__(self) -> FrameStream:
        return self

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._closed = self._cancelled = True
            self._changed.notify_all()
            call = self._call
        try:
            call.cancel()
        finally:
            self._exchange.close()

    def _newest(self) -> Answer | None:
        """The newest answer that has come; None after the last one."""
        with self._changed:
            while not self._answers and not self._over:
                self._changed.wait()
            if self._answers:
                answer = self._answers.take()
                self._taken = answer.message.sequence
                self._changed.notify_all()
                return answer
            if self._failure is not None:
                raise self._failure
            return None

    def _open(self) -> None:
        with self._changed:
            self._opening = self._begin_call()
            messages, listener = self._messages(self._unsent), self._exchange.listener
            call = self._start(messages) if listener is None else LocalCall(self._start, messages, listener)
            self._call = call
            self._changed.notify_all()
        if not call.add_callback(partial(self._ended, call)):
            self._ended(call)

    def _messages(self, unsent: deque[Any]) -> Iterator[Any]:
        """What waits for a call, until another call takes its place, or no more poses come."""
        while True:
            with self._changed:
                self._is_sending = self._is_sending and unsent is not self._unsent
                while unsent is self._unsent and not (
                    unsent or self._real or self._closed or (self._taken and self._unanswered)
                ):
                    self._changed.wait()
                if unsent is not self._unsent:
                    return
                is_opening = bool(unsent) and unsent[0] is self._opening
                message = None
                if self._real and not is_opening:
                    message, self._real = self._real, None
                elif unsent:
                    message = unsent.popleft()
                    self._changed.notify_all()
                taken = None if is_opening else self._take_acknowledgement()
                if message is None and taken is None:
                    return
                self._is_sending = True
            yield self._exchange.departing(message, taken)

    def _ended(self, call: Any) -> None:
        """Frees senders that wait for a call that is over, where none will follow; reading tells the reason, too."""
        failure = None
        if call.code() is not grpc.StatusCode.OK:
            failure = error_of_call(call, self._address)
            if self._retries.may_help(failure):
                return
        with self._changed:
            if call is not self._call:
                return
            if failure is not None and self._exchange.goes_without_memory(failure) and not self._cancelled:
                self._resume(without_memory=True)  # at once: perhaps nobody reads before all poses are sent
                self._open()
                return
            self._closed, self._failure = True, failure
            self._changed.notify_all()

    def _next(self) -> Answer | None:
        while True:
            call = self._call
            try:
                message = next(call, None)
            except grpc.RpcError as failure:
                if not self._go_on(call, error_of_call(failure, self._address)):
                    return None
                continue
            if message is None:
                return None
            with self._changed:
                if (answer := self._accepted(message)) is not None:
                    return answer

    def _go_on(self, broken: Any, error: ClientError) -> bool:
        """Starts another call after a pause; False where nothing is left to be asked. Raises what ends the stream."""
        try:
            with self._changed:
                if self._call is not broken:
                    return True
                gives_up_memory = self._exchange.goes_without_memory(error)
                pause_s = 0.0 if gives_up_memory else self._retries.pause_s(error)
                if self._closed and not self._unanswered and not gives_up_memory:
                    return False
                self._changed.wait_for(lambda: self._cancelled, timeout=pause_s)
                if self._cancelled:
                    raise error
                if self._call is broken:
                    self._resume(without_memory=gives_up_memory)
                    self._open()
        except ClientError as final:
            with self._changed:
                self._closed, self._failure = True, final
                self._changed.notify_all()
            raise
        return True

    def _take_answers(self) -> None:
        try:
            while (answer := self._next()) is not None:
                with self._changed:
                    self._answers.put(answer)
                    self._changed.notify_all()
        except ClientError:
            pass  # the caller is told when there is no answer left
        finally:
            with self._changed:
                self._over = True
                self._changed.notify_all()


class _CallThatKeepsItsStatus:
    """The inner call of a stream under grpc.aio, which gives up the answers and the status that the service sent when
    a write fails because the stream is over (https://github.com/grpc/grpc/issues/36066). This one keeps them.
    """

    def __init__(self, inner: Any) -> None:
        self._inner = inner

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    async def send_serialized_message(self, message: bytes) -> None:
        """Raises StreamEnded where the stream is over; reading says why."""
        try:
            await self._inner.send_serialized_message(message)
        except grpc.aio.InternalError:
            raise StreamEnded(TAKES_NO_MORE) from None


class AsyncFrameStream(_PoseStream):
    """Poses in, frames out; sending and receiving may go on side by side. Leaving it as a context ends it.

    Of a latest stream one task takes answers as they come, and another acknowledges those that the caller took.
    """

    def __init__(self, exchange: PoseExchange, start: Start, retries: Retries, address: str) -> None:
        super().__init__(exchange, start, retries, address)
        self._sending = asyncio.Lock()
        self._waiting_to_go_on = 0  # poses since the call broke
        self._may_send = asyncio.Event()
        self._come = asyncio.Event()  # an answer, or the end of them
        self._may_acknowledge = asyncio.Event()
        self._tasks: tuple[asyncio.Task[None], ...] = ()  # of a latest stream, once it has begun
        self._resending: asyncio.Task[None] | None = None
        self._open()

    async def send(self, pose: PoseLike, *, timeout_s: float | None = None, measured_ns: int | None = None) -> int:
        """Sends a pose ([4, 4] mm, or a Placement) and returns the sequence that its frame will carry, from 1.

        `timeout_s`: later than that the pose is not rendered, and `receive` raises DeadlineExceeded in place of its
        frame. `measured_ns`: when the pose was measured, of `time.monotonic_ns()` (default: now); the frame's
        `latency_ms` counts from it. Raises InvalidPose, StreamEnded, and what ended the stream.
        """
        message = self._exchange.pose(pose, timeout_s, measured_ns)
        await self._send(message)
        return int(message.sequence)

    async def send_real(self, image: npt.ArrayLike | bytes, measured_ns: int) -> None:
        """Sends a frame of the real probe that has come, late: as `FrameStream.send_real`."""
        message = self._exchange.real(image, measured_ns)
        async with self._sending:
            self._unsent.append(message)
            await self._send_waiting()

    async def done_sending(self) -> None:
        """No more poses come; the frames of those that were sent still do, then the iteration ends."""
        self._closed = True
        async with self._sending:
            await self._send_waiting()

    async def receive(self) -> Frame:
        """Waits for the next frame; of a latest stream the newest: those it takes the place of are dropped.

        Raises the ClientError that is told in its place, with the `sequence` of its pose: the stream goes on. Raises
        StreamEnded after the last frame, and what ended the stream, such as Unreachable where it could not go on.
        """
        return self._frame(await (self._newest() if self._is_latest else self._next()))

    def __aiter__(self) -> AsyncIterator[Frame]:
        return self

    async def __anext__(self) -> Frame:
        try:
            return await self.receive()
        except StreamEnded:
            raise StopAsyncIteration from None

    async def __aenter__(self) -> AsyncFrameStream:
        return self

    async def __aexit__(self, *_: object) -> None:
        self._closed = True
        self._call.cancel()
        tasks = [task for task in (*self._tasks, self._resending) if task is not None]
        for task in tasks:
            task.cancel()
        try:
            await asyncio.gather(*tasks, return_exceptions=True)
        finally:
            self._exchange.close()

    async def _send(self, message: Any) -> None:
        if self._waiting_to_go_on >= MAX_WAITING and not self._is_latest:
            await self._may_send.wait()
        async with self._sending:
            if self._failure is not None:
                raise self._failure
            if self._closed:
                raise StreamEnded(TAKES_NO_MORE)
            self._begin()
            self._unanswered.add(message)
            self._unsent.append(message)
            call = self._call
            if await self._send_waiting():
                return
        refusal = await self._refusal_of_memory(call)
        if call is not self._call:  # another has begun meanwhile, with all that has no answer
            return
        if refusal is not None:
            await self._go_on(call, refusal)  # at once: perhaps nobody reads before all poses are sent
        elif self._retries.may_go_on:
            self._waiting_to_go_on += 1
        else:
            raise StreamEnded(TAKES_NO_MORE)

    async def _newest(self) -> Answer | None:
        """The newest answer that has come; None after the last one."""
        self._begin()
        await self._come.wait()
        if self._answers:
            answer = self._answers.take()
            if not self._answers and not self._tasks[0].done():
                self._come.clear()
            self._taken = answer.message.sequence
            if self._unanswered:
                self._may_acknowledge.set()
            return answer
        if self._failure is not None:
            raise self._failure
        return None

    def _open(self) -> None:
        self._begin_call()
        call, listener = self._start(), self._exchange.listener
        call._cython_call = _CallThatKeepsItsStatus(call._cython_call)
        self._call = call if listener is None else AsyncLocalCall(call, listener)

    async def _send_waiting(self) -> bool:
        """Sends what waits; False where the call is over: reading says why."""
        call = self._call
        try:
            while self._unsent:
                await self._call.write(self._exchange.departing(self._unsent.popleft(), self._take_acknowledgement()))
            if self._closed:
                await self._call.done_writing()
        except (asyncio.InvalidStateError, StreamEnded, grpc.RpcError):
            return call is not self._call  # else another call has begun meanwhile, with all that has no answer
        return True

    async def _resend(self) -> None:
        async with self._sending:
            await self._send_waiting()

    async def _next(self) -> Answer | None:
        while True:
            call = self._call
            try:
                message = await call.read()
            except grpc.RpcError as failure:
                if not await self._go_on(call, error_of_call(failure, self._address)):
                    return None
                continue
            if message is grpc.aio.EOF:
                return None
            if (answer := self._accepted(message)) is not None:
                return answer

    async def _go_on(self, broken: Any, error: ClientError) -> bool:
        """Starts another call after a pause; False where nothing is left to be asked. Raises what ends the stream."""
        if self._call is not broken:
            return True
        try:
            gives_up_memory = self._exchange.goes_without_memory(error)
            pause_s = 0.0 if gives_up_memory else self._retries.pause_s(error)
            if self._closed and not self._unanswered and not gives_up_memory:
                return False
            await asyncio.sleep(pause_s)
            if self._call is broken:
                self._resume(without_memory=gives_up_memory)
                self._open()
                self._waiting_to_go_on = 0
                self._resending = asyncio.ensure_future(self._resend())
        except ClientError as final:
            self._failure = final
            raise
        finally:
            self._may_send.set()
            self._may_send.clear()
        return True

    async def _refusal_of_memory(self, over: Any) -> ClientError | None:
        """Why a call ended, where that was because of the memory, which nobody insists on."""
        if not self._exchange.may_give_up_memory:
            return None
        end = await over.code(), await over.initial_metadata(), await over.trailing_metadata(), await over.details()
        error = error_of_call(grpc.aio.AioRpcError(*end), self._address)
        return error if self._exchange.goes_without_memory(error) else None

    def _begin(self) -> None:
        if self._is_latest and not self._tasks:
            self._tasks = tuple(map(asyncio.ensure_future, (self._take_answers(), self._acknowledge())))

    async def _take_answers(self) -> None:
        try:
            while (answer := await self._next()) is not None:
                self._answers.put(answer)
                self._come.set()
        except ClientError:
            pass  # the caller is told when there is no answer left
        finally:
            self._come.set()
            self._tasks[1].cancel()

    async def _acknowledge(self) -> None:
        while True:
            await self._may_acknowledge.wait()
            self._may_acknowledge.clear()
            async with self._sending:
                if self._taken is not None:  # else it went with a pose
                    self._unsent.append(None)
                    await self._send_waiting()
