"""RenderStream: poses in, frames out, in order, several in flight."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Coroutine
from typing import Any

import grpc

from ultragray.errors import Draining, InvalidArgument, UltragrayError
from ultragray_proto.v1 import rendering_pb2
from ultragray_workers.types import Priority, RenderRequest

from ..state import Service
from .messages import error_message, frame_message, pose_from_message
from .planning import plan_settings

MAX_FRAMES_IN_FLIGHT = 8

_log = logging.getLogger("ultragray.grpc")

Answer = asyncio.Task[rendering_pb2.Frame]


class FrameStream:
    """One call of RenderStream: a reader that starts frames and a writer that answers them in order."""

    def __init__(self, service: Service, context: grpc.aio.ServicerContext) -> None:
        self._service = service
        self._context = context
        self._slots = asyncio.Semaphore(MAX_FRAMES_IN_FLIGHT)
        self._answers: asyncio.Queue[Answer | None] = asyncio.Queue()
        self._started: set[Answer] = set()
        self._planned: RenderRequest | None = None

    async def run(self) -> None:
        """Until the client has sent its last message and got its last frame.

        Raises Draining when the service stops.
        """
        reader = asyncio.ensure_future(self._read())
        stopping = asyncio.ensure_future(self._service.draining.wait())
        stopping.add_done_callback(lambda _: reader.cancel())
        try:
            while (answer := await self._answers.get()) is not None:
                await self._context.write(await answer)
                self._slots.release()
            if self._service.draining.is_set():
                raise Draining("the service is stopping; the frames in flight have been answered")
            await reader
        finally:
            stopping.cancel()
            for task in (reader, *self._started):
                task.cancel()

    async def _read(self) -> None:
        try:
            while True:
                await self._slots.acquire()
                message = await self._context.read()
                if message is grpc.aio.EOF:
                    return
                await self._take(message)
        finally:
            self._answers.put_nowait(None)

    async def _take(self, message: rendering_pb2.RenderStreamRequest) -> None:
        try:
            if message.HasField("settings"):
                self._planned = await plan_settings(self._service, message, Priority.INTERACTIVE)
                if not message.HasField("pose"):
                    self._slots.release()
                    return
            if self._planned is None:
                raise InvalidArgument("settings is required before the first pose", field="settings")
            if not message.HasField("pose"):
                raise InvalidArgument("pose or settings is required", field="pose")
            pose = pose_from_message(message.pose, "pose")
            deadline = self._service.planner.deadline(self._context.time_remaining())
            prepared = self._service.planner.with_poses(self._planned, pose[None], deadline)
        except UltragrayError as error:
            self._start(self._refuse(message.sequence, error))
        else:
            self._start(self._answer(message.sequence, prepared))

    def _start(self, work: Coroutine[Any, Any, rendering_pb2.Frame]) -> None:
        answer: Answer = asyncio.create_task(work)
        self._started.add(answer)
        answer.add_done_callback(self._started.discard)
        self._answers.put_nowait(answer)

    async def _answer(self, sequence: int, prepared: RenderRequest) -> rendering_pb2.Frame:
        try:
            return frame_message(await self._service.render(prepared), sequence)
        except UltragrayError as error:
            return await self._refuse(sequence, error)
        except Exception:
            _log.exception("unexpected error in a stream")
            return await self._refuse(sequence, UltragrayError("an unexpected error, see the log"))

    async def _refuse(self, sequence: int, error: UltragrayError) -> rendering_pb2.Frame:
        self._service.metrics.count_frame_error(error.reason)
        return rendering_pb2.Frame(sequence=sequence, error=error_message(error))
