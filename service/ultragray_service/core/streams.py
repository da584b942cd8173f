"""Poses of one client as they come, frames in their order: what every streaming front door shares."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from enum import Enum
from functools import partial
from typing import Any, Protocol

from ultragray.errors import InvalidArgument, UltragrayError
from ultragray.geometry.motion import MAX_AHEAD_MS, PathPredictor, Prediction
from ultragray.geometry.probe import FloatArray
from ultragray.learn.localization.pixels import EncodedFrame
from ultragray.rendering.preview import Preview
from ultragray.rendering.settings import RenderSettings, Resolved
from ultragray_service.core.clocks import ClientClock, ClockStamps, service_time_s
from ultragray_service.core.open_streams import OpenStream, StreamAnswer
from ultragray_service.core.previews import RealFrame, StreamPreview
from ultragray_service.core.rendering import PendingFrames, Plan, Rendering
from ultragray_workers.errors import Draining
from ultragray_workers.pool.messages import Destination, RenderResult

MAX_FRAMES_IN_FLIGHT = 8  # of an ordered stream; then it stops reading
MAX_BYTES_IN_FLIGHT = 32 * 2**20  # of their frames, if there is more than one
MAX_MESSAGE_BYTES = 2**21  # of a client, on a WebSocket or through a socket of the host; of one with a real frame
MAX_POSE_BYTES = 2**16  # of one without
MAX_WINDOW = 16  # answers of a latest stream that its client may have yet to acknowledge

_log = logging.getLogger("ultragray.stream")


class StreamMode(str, Enum):
    """The fate of a pose that still waits when the next one comes."""

    ORDERED = "ordered"  # every pose gets its frame
    LATEST = "latest"  # the newer pose takes its place in the queue; it gets no frame, and is counted


Correct = Callable[[RenderResult], Awaitable[tuple[RenderResult, Preview | None]]]


@dataclass(frozen=True, eq=False)
class PoseRequest:
    """One pose of a client, checked."""

    sequence: int
    client_time: float | None  # any number (an int for gRPC): the client gets it back
    measured_s: float | None  # the same in seconds
    plan: Plan  # the same object until the client sends other settings
    pose: FloatArray  # [4, 4] mm, exact
    prediction: Prediction | None  # how the pose was foretold; None: it is as the client sent it
    deadline: float  # time.monotonic() in seconds
    correct: Correct | None = None  # by the real frames of the stream


Write = Callable[[StreamAnswer], Awaitable[None]]


@dataclass(eq=False)
class _Underway:
    """An answer on its way, in its place among those of its stream: to a pose, or to a message that gets no frame."""

    sequence: int
    client_time: float | None
    frames: PendingFrames[Resolved] | UltragrayError  # or why there are none
    release: Callable[[], None]  # called when it has been written
    request: PoseRequest | None = None  # the newest that its frame is for


class _Room:
    def __init__(self) -> None:
        self._count = self._bytes = 0
        self._departure = asyncio.Event()

    async def enter(self, size: int) -> None:
        """Waits until there is room for an answer of so many bytes; alone it may be of any size."""
        while self._count and (self._count >= MAX_FRAMES_IN_FLIGHT or self._bytes + size > MAX_BYTES_IN_FLIGHT):
            self._departure.clear()
            await self._departure.wait()
        self._count += 1
        self._bytes += size

    def leave(self, size: int) -> None:
        self._count -= 1
        self._bytes -= size
        self._departure.set()


class _Window:
    """The answers of a latest stream that are between the service and the hands of its client.

    A pose is rendered only once there is room, so that it is the newest one then. A client that acknowledges has
    opened a window of several answers, which leave it when they are acknowledged; of one that does not, one answer at
    a time is on its way, until the transport has handed it over.
    """

    def __init__(self) -> None:
        self._size: int | None = None  # None: the client acknowledges nothing
        self._entered: deque[int] = deque()  # sequences, in the order of the answers

    def open(self, size: int) -> None:
        self._size = size

    @property
    def is_open(self) -> bool:
        return self._size is not None

    @property
    def has_room(self) -> bool:
        return len(self._entered) < (1 if self._size is None else self._size)

    def enter(self, sequence: int) -> None:
        self._entered.append(sequence)

    def leave(self) -> None:
        if self._size is None:
            self._entered.popleft()

    def acknowledge(self, sequence: int) -> None:
        """The client has taken the answer of that sequence, and those before it are of no use any more."""
        if self._size is not None and sequence in self._entered:
            while self._entered.popleft() != sequence:
                pass


class PoseStream:
    def __init__(self, rendering: Rendering, record: OpenStream | None = None) -> None:
        self.mode = StreamMode.ORDERED  # to be set before the first pose, likewise:
        self.destination: Destination | None = None  # of its frames
        self.clock = ClientClock()
        self._rendering = rendering
        self._record = record or OpenStream()
        self._room = _Room()
        self._answers: asyncio.Queue[_Underway | None] = asyncio.Queue()
        self._open: set[PendingFrames[Resolved]] = set()  # frames that are still to be answered
        self._ended = False  # no more poses come
        self._dropped = 0
        # Of a latest stream: what is asked of the pool, and what comes after it.
        self._current: _Underway | None = None
        self._next: PoseRequest | None = None
        self._waiting: asyncio.Task[None] | None = None  # for the limits of its key to allow the next one
        self._window = _Window()

    async def run(self, read: Callable[[], Awaitable[None]], send: Write, hand_over: Write) -> None:
        """Until the client has sent its last pose and got its last frame.

        `read` takes messages to `ask` and `refuse` until there are no more. `hand_over` sends the answers of a latest
        stream whose client acknowledges none, `send` all others. Raises Draining when the service stops, after the
        frames in flight, and what the three raise.
        """
        reader = asyncio.ensure_future(self._read(read))
        writer = asyncio.ensure_future(self._write(send, hand_over))
        stopping = asyncio.ensure_future(self._rendering.life.draining.wait())
        stopping.add_done_callback(partial(_cancel, reader))
        self._rendering.metrics.count_stream(+1)
        try:
            await asyncio.wait({reader, writer}, return_when=asyncio.FIRST_EXCEPTION)
            if reader.done() and not reader.cancelled():
                if isinstance(reader.exception(), UltragrayError):
                    await asyncio.wait({writer})  # gRPC cannot end a call while an answer is being written
                reader.result()
            if writer.done() and not writer.cancelled():
                writer.result()
            if self._rendering.life.draining.is_set():
                raise Draining("the service is stopping; the frames in flight have been answered")
        finally:
            self._rendering.metrics.count_stream(-1)
            self._next = None  # else the end of the reader would have it asked for
            tasks = [reader, writer, stopping, *([] if self._waiting is None else [self._waiting])]
            for task in tasks:
                task.cancel()
            try:
                await asyncio.gather(*tasks, return_exceptions=True)  # those that have failed already, too
            finally:  # also where this is cancelled once more
                self._answers = asyncio.Queue()
                while self._open:
                    self._open.pop().close()
                tasks.clear()
                del reader, writer  # what they raised holds on to this call, and that to frames that nobody takes

    async def ask(self, request: PoseRequest) -> None:
        """Takes a pose. An ordered stream waits while too many frames are in flight, or its key may have none yet."""
        self._record.count_pose()
        if self.mode is StreamMode.ORDERED:
            settings = request.plan.settings
            size = settings.pixels * settings.encoding.pixel_type.itemsize
            await self._room.enter(size)
            try:
                await self._rendering.limits.frame_turn(request.deadline)
            except UltragrayError as error:
                frames: PendingFrames[Resolved] | UltragrayError = self._refused(error)
            else:
                frames = self._request_frames(request)
            self._begin(request, frames, release=partial(self._room.leave, size))
            return
        if self._next is None and self._take_over(request):
            self._count_dropped()
            return
        if self._next is not None:
            self._count_dropped()
        self._next = request
        self._advance()

    def open_window(self, size: int) -> None:
        self._window.open(size)

    def acknowledge(self, sequence: int) -> None:
        self._window.acknowledge(sequence)
        self._advance()

    async def refuse(self, sequence: int, client_time: float | None, error: UltragrayError) -> None:
        """Takes a message that gets no frame. Waits while too many answers are under way."""
        await self._room.enter(0)
        self._answers.put_nowait(
            _Underway(sequence, client_time, self._refused(error), release=partial(self._room.leave, 0))
        )

    async def _read(self, read: Callable[[], Awaitable[None]]) -> None:
        try:
            await read()
        finally:
            self._ended = True
            self._advance()

    async def _write(self, send: Write, hand_over: Write) -> None:
        while (underway := await self._answers.get()) is not None:
            answer = await self._answer(underway)
            self._record.note(answer)
            write = send if self.mode is StreamMode.ORDERED or self._window.is_open else hand_over
            await write(answer)
            underway.release()

    async def _answer(self, underway: _Underway) -> StreamAnswer:
        """Waits for a frame. That of a latest stream makes way for the next pose before it is written."""
        outcome, preview = await self._outcome(underway), None
        request = underway.request
        if underway is self._current:
            assert request is not None
            self._current = None
            self._window.enter(request.sequence)
            self._advance()
        if request is not None and request.correct is not None and not isinstance(outcome, UltragrayError):
            outcome, preview = await request.correct(outcome)
        dropped, self._dropped = self._dropped, 0
        origin = underway if request is None else request
        return StreamAnswer(
            origin.sequence,
            origin.client_time,
            outcome,
            dropped,
            prediction=None if request is None else request.prediction,
            preview=preview,
            measured_s=None if request is None else request.measured_s,
            clock=self.clock.offset(service_time_s()),
        )

    async def _outcome(self, underway: _Underway) -> RenderResult | UltragrayError:
        frames = underway.frames
        if isinstance(frames, UltragrayError):
            return frames
        try:
            return await frames.frames()
        except UltragrayError as error:
            return self._refused(error)
        except Exception as error:
            return self._refused(unexpected(error))
        finally:
            frames.close()
            self._open.discard(frames)

    def _request_frames(self, request: PoseRequest) -> PendingFrames[Resolved] | UltragrayError:
        """The frame of a pose, which waits in the pool from now on; else why there will be none."""
        destination = self.destination if request.correct is None else None  # its pixels are made here
        try:
            frames = self._rendering.ask(
                request.plan, request.pose[None], deadline=request.deadline, destination=destination
            )
        except UltragrayError as error:
            return self._refused(error)
        except Exception as error:
            return self._refused(unexpected(error))
        self._open.add(frames)
        return frames

    def _begin(
        self, request: PoseRequest, frames: PendingFrames[Resolved] | UltragrayError, release: Callable[[], None]
    ) -> _Underway:
        underway = _Underway(request.sequence, request.client_time, frames, release, request)
        self._answers.put_nowait(underway)
        return underway

    def _refused(self, error: UltragrayError) -> UltragrayError:
        self._rendering.metrics.count_frame_error(error)
        return error

    def _take_over(self, request: PoseRequest) -> bool:
        """Puts a pose into the place of the one that waits in the pool, if that is not begun."""
        current = self._current
        if current is None or current.request is None or isinstance(current.frames, UltragrayError):
            return False
        if current.request.plan is not request.plan or (current.request.correct is None) != (request.correct is None):
            return False
        if not current.frames.give_to(request.pose[None], request.deadline):
            return False
        current.request = request
        return True

    def _advance(self) -> None:
        """Asks the pool for what comes next, once it may; ends the answers after the last one."""
        has_room = self._window.has_room or self._ended  # a client that has ended cannot acknowledge any more
        if self._next is not None and self._current is None and self._waiting is None and has_room:
            if self._rendering.limits.mine.frames_per_s is None:
                self._ask_next()
            else:
                self._waiting = asyncio.create_task(self._ask_next_in_turn())
        if self._ended and self._next is None:
            self._answers.put_nowait(None)

    async def _ask_next_in_turn(self) -> None:
        try:
            await self._rendering.limits.frame_turn(None)  # meanwhile newer poses, with later deadlines, may come
        finally:
            self._waiting = None
        self._ask_next()
        if self._ended:
            self._answers.put_nowait(None)

    def _ask_next(self) -> None:
        assert self._next is not None
        request, self._next = self._next, None
        self._current = self._begin(request, self._request_frames(request), release=self._leave_window)

    def _leave_window(self) -> None:
        self._window.leave()
        self._advance()

    def _count_dropped(self) -> None:
        self._dropped += 1
        self._rendering.metrics.count_dropped()


def unexpected(error: Exception) -> UltragrayError:
    """The refusal of a message that a fault of the service kept from its frame; the log has the fault."""
    _log.error("unexpected error in a stream", exc_info=error)
    return UltragrayError("an unexpected error, see the log")


def _cancel(task: asyncio.Task[None], _: asyncio.Future[bool]) -> None:
    task.cancel()


MAX_TIMEOUT_MS = 3_600_000.0

SceneSettings = tuple[str, RenderSettings]


def nothing() -> None:
    """What a message says that leaves something out."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Message:
    """A message of the client. What cannot be used is raised, as InvalidArgument, by the call that would give it."""

    sequence: int = 0
    client_time: float | None = None
    mode: Callable[[], StreamMode | None] = nothing  # asked of the first; None: it cannot be read, the next one may
    window: int | None = None  # of the first: answers of a latest stream that may wait to be acknowledged; None: none
    acknowledged: int | None = None  # the sequence of the newest answer that the client has taken
    settings: Callable[[], SceneSettings | None] = nothing  # from now on; None: as before
    asks: bool = True  # for a frame
    pose: Callable[[], FloatArray]  # [4, 4] mm, exact
    timeout_s: Callable[[], float | None] = nothing  # that the pose may wait; None: the default of the service
    measured_s: float | None = None  # when the pose was, by the client's clock; there where there is an `ahead_s`
    ahead_s: Callable[[], float | None] = nothing  # how much later its frame is to be; None: for the pose as it was
    real: Callable[[], RealFrame | None] = nothing  # a real frame, which came late
    stamps: ClockStamps | None = None
    arrived_s: float = field(default_factory=service_time_s)


def unreadable(error: UltragrayError, *, of_settings: bool = False, **numbers: Any) -> Message:
    """A message that could not be read: it has its numbers, as far as these can, and raises why."""

    def refuse() -> Any:
        raise error

    return Message(**numbers, settings=refuse if of_settings else nothing, pose=refuse)


class Transport(Protocol):
    """The connection that messages come through."""

    @property
    def destination(self) -> Destination | None:
        """Where frames are put, once the mode was asked for; None: into the answers."""

    async def receive(self) -> Message | None:
        """The next message; None after the last."""

    async def send(self, answer: StreamAnswer) -> None:
        """Sends a frame, or why there is none."""

    async def hand_over(self, answer: StreamAnswer) -> None:
        """Sends, and waits until the client has taken the answer, as far as the transport can tell."""


class FrameStream:
    """Poses in, frames out. Refused settings change nothing: those before them stay, `unset` at the beginning.

    A client whose first settings are refused gets no frames with settings that it did not ask for.
    """

    def __init__(
        self,
        rendering: Rendering,
        transport: Transport,
        unset: SceneSettings | None = None,
        record: OpenStream | None = None,
    ) -> None:
        self._rendering, self._transport, self._unset = rendering, transport, unset
        self._plan: Plan | None = None
        self._poses_of: tuple[str, str | None] | None = None  # scene, and registration that leads into it
        self._path = PathPredictor()  # of the placed poses, likewise:
        self._preview = StreamPreview(rendering)
        if record is not None:
            record.take_real = self._take_real
        self._poses = PoseStream(rendering, record)

    async def run(self) -> None:
        """Until the client has sent its last message and got its last frame. Raises Draining when the service stops."""
        try:
            await self._poses.run(self._read, self._transport.send, self._transport.hand_over)
        finally:
            await self._preview.close()

    async def _read(self) -> None:
        mode = None
        while (message := await self._transport.receive()) is not None:
            if mode is None and (mode := message.mode()) is not None:
                self._poses.mode, self._poses.destination = mode, self._transport.destination
                if message.window is not None:
                    self._poses.open_window(message.window)
            if message.stamps is not None:
                self._poses.clock.observe(message.stamps, message.arrived_s)
            if message.acknowledged is not None:
                self._poses.acknowledge(message.acknowledged)
            await self._take(message)

    async def _take(self, message: Message) -> None:
        try:
            request = await self._pose_request(message)
        except UltragrayError as error:
            await self._poses.refuse(message.sequence, message.client_time, error)
        except Exception as error:
            await self._poses.refuse(message.sequence, message.client_time, unexpected(error))
        else:
            if request is not None:
                await self._poses.ask(request)

    async def _pose_request(self, message: Message) -> PoseRequest | None:
        await self._change_settings(message)
        if (real := message.real()) is not None:
            await self._preview.take(real, self._plan)
        if not message.asks:
            return None
        if self._plan is None:
            if self._unset is None:
                raise InvalidArgument("settings must be given, and accepted, before the first pose", field="settings")
            self._plan = await self._resolve(self._unset)
        deadline = self._rendering.planner.deadline(message.timeout_s())
        pose, prediction = self._plan.placed(message.pose()), None
        if message.measured_s is not None:
            self._preview.note(message.measured_s, pose)
        if (ahead_s := message.ahead_s()) is not None and message.measured_s is not None:
            self._path.observe(message.measured_s, pose)
            pose, prediction = self._path.predict(message.measured_s + ahead_s)
        correct, corrected = None, pose
        if self._preview.is_on and message.measured_s is not None:
            seen_s = message.measured_s + (0.0 if prediction is None else prediction.ahead_ms / 1e3)
            correct, corrected = partial(self._preview.shown, pose=pose, at_s=seen_s), self._preview.corrected(pose)
        return PoseRequest(
            message.sequence,
            message.client_time,
            message.measured_s,
            self._plan,
            corrected,
            prediction,
            deadline,
            correct,
        )

    async def _take_real(self, image: EncodedFrame, measured_s: float | None, age_s: float | None) -> None:
        """Takes a real frame that does not come by the stream itself: `TakeReal`."""
        if (measured_s is None) == (age_s is None):
            raise InvalidArgument("exactly one of client_time_ms and age_ms must be given", field="age_ms")
        if age_s is not None:
            now_s = service_time_s()
            if (offset := self._poses.clock.offset(now_s)) is None:
                raise InvalidArgument(
                    "age_ms takes a stream whose messages align the clocks (clock); else give client_time_ms",
                    field="age_ms",
                )
            measured_s = now_s - age_s + offset.offset_ms / 1e3
        assert measured_s is not None
        await self._preview.take(RealFrame(image, measured_s), self._plan)

    async def _change_settings(self, message: Message) -> None:
        unset, self._unset = self._unset, None  # as long as the message's own are not known to be none
        settings = message.settings()
        if settings is None:
            self._unset = unset
        else:
            self._plan = await self._resolve(settings)
            scene, request = settings
            if self._poses_of != (scene, request.registration):
                self._poses_of, self._path = (scene, request.registration), PathPredictor()
                await self._preview.close()
                self._preview = StreamPreview(self._rendering)

    async def _resolve(self, settings: SceneSettings) -> Plan:
        scene, request = settings
        return await self._rendering.planner.plan(
            scene, request, request.encoding, path="settings", registration=request.registration
        )


def ahead_s(client_time: float | None, predict_ms: float | None, name: str) -> float | None:
    """`Message.ahead_s` of a client's numbers; `name`: the field of `client_time`. Raises InvalidArgument."""
    if predict_ms is None:
        return None
    if not 0.0 <= predict_ms <= MAX_AHEAD_MS:
        raise InvalidArgument(f"predict_ms must be from 0 to {MAX_AHEAD_MS:g}, got {predict_ms:g}", field="predict_ms")
    if client_time is None:
        raise InvalidArgument(f"{name} must be given beside predict_ms: when the pose was measured", field=name)
    return predict_ms / 1e3


def checked_s(name: str, milliseconds: float) -> float:
    if not 0.0 < milliseconds <= MAX_TIMEOUT_MS:
        raise InvalidArgument(
            f"{name} must be above 0 and at most {MAX_TIMEOUT_MS:g}, got {milliseconds:g}", field=name
        )
    return milliseconds / 1000.0
