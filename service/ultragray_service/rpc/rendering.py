"""RenderService: a frame, a batch of frames, a stream of poses, slices and searches."""

from __future__ import annotations

import asyncio
import socket
import struct
import time
from collections import deque
from collections.abc import Awaitable, Callable
from contextlib import suppress
from functools import partial
from typing import Any, TypeAlias

import grpc
from google.protobuf.message import DecodeError

from ultragray.contract import under
from ultragray.errors import FrameTooCostly, InvalidArgument, LowConfidence, UltragrayError
from ultragray.geometry.probe import FloatArray
from ultragray.learn.localization.pixels import EncodedFrame
from ultragray.learn.localization.settings import LocalizationSettings
from ultragray.learn.planning.settings import MAX_LISTED, PlanSettings
from ultragray.rendering.volumes import SliceSettings
from ultragray_proto.codec import to_message
from ultragray_proto.v1 import rendering_pb2, scenes_pb2
from ultragray_service.core.clocks import ClockStamps, service_time_s
from ultragray_service.core.open_streams import StreamAnswer
from ultragray_service.core.poses import check_pose_count, exact_poses
from ultragray_service.core.previews import RealFrame
from ultragray_service.core.rendering import Plan
from ultragray_service.core.streams import (
    MAX_MESSAGE_BYTES,
    MAX_WINDOW,
    FrameStream,
    Message,
    StreamMode,
    ahead_s,
    checked_s,
    unreadable,
)
from ultragray_service.errors import Refusal
from ultragray_service.rpc.messages import (
    OfProbe,
    read,
    read_pose,
    read_settings,
    read_word,
    serialized_frame,
    slice_message,
)
from ultragray_service.rpc.shared_memory import SharedMemory
from ultragray_service.service import Service
from ultragray_service.views.poses import locate, next_views, sought_frame
from ultragray_workers.errors import QueueFull
from ultragray_workers.pool.messages import Priority, RenderResult

Context: TypeAlias = grpc.aio.ServicerContext
_LENGTH = struct.Struct("<I")


class CallTransport:
    """One call of RenderStream; a context manager. Its mode is read from the first message that can be read.

    The messages of a client of this host may go through a socket that it shares with its memory (`_Socket`).
    """

    def __init__(self, context: Context) -> None:
        self._context = context
        self._socket: _Socket | None = None
        self.destination: SharedMemory | None = None

    async def __aenter__(self) -> CallTransport:
        return self

    async def __aexit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self.destination is not None:
            self.destination.close()
        if self._socket is not None:
            await self._socket.close(at_once=kind is asyncio.CancelledError)

    async def receive(self) -> Message | None:
        try:
            message = await (self._context if self._socket is None else self._socket).read()
        except InvalidArgument as error:  # bytes that are no RenderStreamRequest
            return unreadable(error)
        if message is grpc.aio.EOF:
            return None
        left_s: float | None = self._context.time_remaining()
        has = message.HasField

        def pose() -> FloatArray:  # [4, 4] mm
            if not has("pose"):
                raise InvalidArgument("pose or settings is required", field="pose")
            return read_pose(message.pose, "pose")

        def timeout_s() -> float | None:
            if not has("timeout_ms"):
                return left_s
            own_s = checked_s("timeout_ms", message.timeout_ms)
            return own_s if left_s is None else min(left_s, own_s)

        client_time_ns = message.client_time_ns if has("client_time_ns") else None

        def real() -> RealFrame | None:
            if not has("real"):
                return None
            frame = message.real
            height, width = (
                getattr(frame, side) if frame.HasField(side) else None for side in ("image_height", "image_width")
            )
            return RealFrame(EncodedFrame(frame.image, height, width), frame.client_time_ns / 1e9)

        predict_ms = message.predict_ms if has("predict_ms") else None
        clock = message.clock
        return Message(
            sequence=message.sequence,
            client_time=client_time_ns,
            mode=partial(self._begin, message),
            window=message.window or None,
            acknowledged=message.acknowledged if has("acknowledged") else None,
            settings=lambda: read_settings(message) if has("settings") else None,
            asks=has("pose") or not (has("settings") or has("acknowledged") or has("real")),
            pose=pose,
            timeout_s=timeout_s,
            measured_s=None if client_time_ns is None else client_time_ns / 1e9,
            ahead_s=lambda: ahead_s(client_time_ns, predict_ms, "client_time_ns"),
            real=real,
            stamps=(
                ClockStamps(clock.answer_sent_ns / 1e9, clock.answer_arrived_ns / 1e9, clock.sent_ns / 1e9)
                if has("clock")
                else None
            ),
        )

    def _begin(self, first: rendering_pb2.RenderStreamRequest) -> StreamMode:
        """The mode that the first message asks for; opens the memory that the client shares, too.

        Raises InvalidArgument for a mode that does not exist, a latest stream without a window or with one beyond the
        limit, and memory that is refused.
        """
        mode = StreamMode(read_word(first, "mode") or StreamMode.ORDERED)
        if mode is StreamMode.LATEST and not 1 <= first.window <= MAX_WINDOW:
            raise InvalidArgument(
                f"a latest stream needs a window of 1 to {MAX_WINDOW} answers, each acknowledged when it is taken "
                f"(HTTP/2 would hold seconds of unread frames), got {first.window}",
                field="window",
            )
        if first.HasField("shared_memory"):
            self.destination = SharedMemory(first.shared_memory, self._context.peer())
            if self.destination.socket is not None:
                self._socket = _Socket(self.destination.socket)
        return mode

    async def send(self, answer: StreamAnswer) -> None:
        about: dict[str, Any] = {"dropped": answer.dropped, "sent_ns": round(1e9 * service_time_s())}
        if answer.clock is not None:
            about["clock"] = to_message(answer.clock, rendering_pb2.ClockOffset)
        if answer.client_time is not None:
            about["client_time_ns"] = int(answer.client_time)
        message: rendering_pb2.Frame | bytes
        if isinstance(answer.outcome, UltragrayError):
            error = to_message(Refusal.of(answer.outcome), scenes_pb2.Error)
            message = rendering_pb2.Frame(sequence=answer.sequence, error=error, **about)
        else:
            if answer.prediction is not None:
                about["prediction"] = to_message(answer.prediction, rendering_pb2.Prediction)
            if answer.preview is not None:
                about["preview"] = to_message(answer.preview, rendering_pb2.Preview)
            message = serialized_frame(answer.outcome, answer.sequence, **about)
        await (self._context if self._socket is None else self._socket).write(message)

    hand_over = send  # of streams without a window, which are ordered ones here


class _Socket:
    """The messages of a stream through a socket, each behind its length; read and written as those of a call."""

    def __init__(self, end: socket.socket) -> None:
        self._is_over = False  # no more messages are read
        self._opening = asyncio.ensure_future(asyncio.open_unix_connection(sock=end))
        self._ends: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None  # once it is open

    async def read(self) -> Any:  # rendering_pb2.RenderStreamRequest | grpc.aio.EOF
        """Raises InvalidArgument for what is no message, and for one that is too large, which ends the messages."""
        reader, _ = self._ends or await self._opened()
        if self._is_over:
            return grpc.aio.EOF
        try:
            (size,) = _LENGTH.unpack(await reader.readexactly(_LENGTH.size))
            if size > MAX_MESSAGE_BYTES:
                self._is_over = True
                raise InvalidArgument(f"a message may have at most {MAX_MESSAGE_BYTES} bytes, got {size}")
            return rendering_pb2.RenderStreamRequest.FromString(await reader.readexactly(size))
        except (asyncio.IncompleteReadError, OSError):
            return grpc.aio.EOF
        except DecodeError:
            raise InvalidArgument("the bytes are not a message of the type that the method takes") from None

    async def write(self, message: rendering_pb2.Frame | bytes) -> None:
        _, writer = self._ends or await self._opened()
        if writer.is_closing():  # the client is gone, which ends its call, too
            return
        data = message if isinstance(message, bytes) else message.SerializeToString()
        try:
            writer.write(_LENGTH.pack(len(data)) + data)
            await writer.drain()
        except OSError:  # likewise
            return

    async def _opened(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        self._ends = await asyncio.shield(self._opening)
        return self._ends

    async def close(self, *, at_once: bool) -> None:
        """Ends the messages, unless `at_once` when those that were written are with the client."""
        _, writer = await self._opening
        if at_once:
            writer.transport.abort()
        writer.close()
        with suppress(OSError):
            await writer.wait_closed()


_RETRY_S = 0.02
_STREAM_NAME = "x-ultragray-stream-name"  # metadata


class RenderService:
    def __init__(self, service: Service) -> None:
        self._service = service

    async def Render(self, request: rendering_pb2.RenderRequest, context: Context) -> bytes:  # of a Frame
        deadline = self._service.planner.deadline(context.time_remaining())
        begin_by = None
        if request.HasField("max_queue_ms"):
            begin_by = self._service.planner.deadline(checked_s("max_queue_ms", request.max_queue_ms))
        plan = await self._plan(request)
        if not request.HasField("pose"):
            raise InvalidArgument("pose is required", field="pose")
        pose = plan.placed(read_pose(request.pose, "pose"))
        await self._service.limits.take_frames(1, deadline)
        result = await self._service.rendering.render(plan, pose[None], deadline=deadline, begin_by=begin_by)
        return serialized_frame(result, 0)

    async def RenderBatch(self, request: rendering_pb2.RenderBatchRequest, context: Context) -> None:
        planner = self._service.planner
        check_pose_count(len(request.poses), planner.max_poses)
        plan = await self._plan(request)
        inputs = await exact_poses(len(request.poses), lambda index: read_pose(request.poses[index], f"poses[{index}]"))
        poses = plan.placed(inputs)
        window = min(2 * self._service.settings.max_batch_poses, self._service.settings.queue_limit_frames)
        in_flight: deque[asyncio.Task[RenderResult]] = deque()
        started = 0
        try:
            for sequence in range(len(poses)):
                while started < len(poses) and len(in_flight) < window:
                    some = poses[started : started + 1]
                    render = self._render if started == 0 else self._render_when_room
                    in_flight.append(asyncio.ensure_future(self._in_turn(render, plan, some, context)))
                    started += 1
                try:
                    result = await in_flight[0]
                except (LowConfidence, FrameTooCostly) as error:
                    field = f"poses[{sequence}]"
                    raise type(error)(error.detail.replace("pose", field, 1), field=field) from None
                in_flight.popleft()
                await context.write(serialized_frame(result, sequence))
        finally:
            for task in in_flight:
                task.cancel()
            await asyncio.gather(*in_flight, return_exceptions=True)

    async def RenderStream(self, messages: object, context: Context) -> None:
        metadata = {key: value for key, value in context.invocation_metadata() or () if isinstance(value, str)}
        name = metadata.get(_STREAM_NAME) or metadata.get("user-agent", "")
        streams = self._service.streams
        with self._service.limits.stream(), streams.opened("grpc", name) as noted:
            async with CallTransport(context) as transport:
                await FrameStream(self._service.rendering, transport, record=noted).run()

    async def AssessPoses(
        self, request: rendering_pb2.AssessPosesRequest, context: Context
    ) -> rendering_pb2.AssessPosesResponse:
        check_pose_count(len(request.poses), self._service.planner.max_poses)
        whose = read(request, OfProbe)
        poses = await exact_poses(len(request.poses), lambda index: read_pose(request.poses[index], f"poses[{index}]"))
        assessment = await self._service.assessing.assess(request.scene, poses, whose.probe, whose.registration)
        return to_message(assessment, rendering_pb2.AssessPosesResponse)

    async def RenderSlice(self, request: rendering_pb2.RenderSliceRequest, context: Context) -> rendering_pb2.Slice:
        deadline = self._service.planner.deadline(context.time_remaining())
        if not request.HasField("slice"):
            raise InvalidArgument("slice is required", field="slice")
        with under("slice"):
            settings = read(request.slice, SliceSettings)
        plan = await self._service.planner.plan_slice(request.scene, settings, settings.numbers, path="slice")
        await self._service.limits.take_frames(1, deadline)
        result = await self._service.rendering.render_slice(plan, settings.pose(), deadline=deadline)
        return slice_message(result)

    async def Localize(
        self, request: rendering_pb2.LocalizeRequest, context: Context
    ) -> rendering_pb2.LocalizeResponse:
        deadline = self._service.planner.deadline(context.time_remaining())
        settings = read(request, LocalizationSettings)
        height, width = (
            getattr(request, side) if request.HasField(side) else None for side in ("image_height", "image_width")
        )
        start = read_pose(request.start, "start") if request.HasField("start") else None
        sought = sought_frame(request.image, height, width, settings)
        registration = request.registration if request.HasField("registration") else None
        match = await locate(self._service.rendering, request.scene, sought, start, deadline, registration)
        return to_message(match, rendering_pb2.LocalizeResponse)

    async def PlanViews(
        self, request: rendering_pb2.PlanViewsRequest, context: Context
    ) -> rendering_pb2.PlanViewsResponse:
        deadline = self._service.planner.deadline(context.time_remaining())
        settings, poses = read(request, PlanSettings), None
        if count := len(request.poses):
            check_pose_count(count, MAX_LISTED)
            poses = await exact_poses(count, lambda index: read_pose(request.poses[index], f"poses[{index}]"))
        view, start = (
            read_pose(getattr(request, name), name) if request.HasField(name) else None for name in ("view", "start")
        )
        registration = request.registration if request.HasField("registration") else None
        view_plan = await next_views(
            self._service.rendering,
            request.scene,
            settings,
            deadline,
            poses=poses,
            view=view,
            start=start,
            registration=registration,
        )
        return to_message(view_plan, rendering_pb2.PlanViewsResponse)

    async def _plan(self, request: rendering_pb2.RenderRequest | rendering_pb2.RenderBatchRequest) -> Plan:
        scene, settings = read_settings(request)
        return await self._service.planner.plan(
            scene, settings, settings.encoding, path="settings", registration=settings.registration
        )

    async def _in_turn(
        self,
        render: Callable[[Plan, FloatArray, float], Awaitable[RenderResult]],
        plan: Plan,
        pose: FloatArray,
        context: Context,
    ) -> RenderResult:
        left_s = context.time_remaining()
        await self._service.limits.frame_turn(None if left_s is None else time.monotonic() + left_s)
        return await render(plan, pose, self._service.planner.deadline(context.time_remaining()))

    async def _render(self, plan: Plan, pose: FloatArray, deadline: float) -> RenderResult:
        return await self._service.rendering.render(plan, pose, priority=Priority.BATCH, deadline=deadline)

    async def _render_when_room(self, plan: Plan, pose: FloatArray, deadline: float) -> RenderResult:
        """Renders a frame of a batch that was let in already: a full queue delays it."""
        while True:
            try:
                return await self._render(plan, pose, deadline)
            except QueueFull:
                if time.monotonic() + _RETRY_S >= deadline:
                    raise
            await asyncio.sleep(_RETRY_S)
