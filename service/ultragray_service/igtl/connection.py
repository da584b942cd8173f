"""One OpenIGTLink client: what it sends, what it gets, and how long it may take."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace

from ultragray.errors import UltragrayError
from ultragray.rendering.settings import FrameSettings
from ultragray_service.core.clocks import service_time_s
from ultragray_service.core.open_streams import OpenStream, StreamAnswer
from ultragray_service.core.unread import Unread, hold_little
from ultragray_service.errors import IgtlMessageInvalid
from ultragray_service.igtl.commands import Scanner, Setup, answer
from ultragray_service.igtl.contents import (
    CAPABILITY,
    COMMAND_TYPES,
    HEARD,
    KINDS,
    OK,
    POSE_TYPES,
    UNDERSTOOD,
    Status,
    pack_capability,
    pack_status,
    state_of,
    unpack_instruments,
    unpack_interval_s,
    unpack_position,
    unpack_transform,
    unpack_video_query,
)
from ultragray_service.igtl.frames import Feed, Frame, PoseMessage, Underway, WaitingPoses, render_frame
from ultragray_service.igtl.messages import (
    HEADER_BYTES,
    TICKS_PER_S,
    Header,
    Message,
    pack_message,
    unpack_header,
    unpack_message,
)
from ultragray_service.igtl.routes import SceneChooser
from ultragray_service.igtl.video import VideoEncoder
from ultragray_service.service import Service
from ultragray_workers.pool.messages import RenderResult

MAX_BODY_BYTES = 64 * 1024  # of a message that is read
MAX_SKIPPED_BYTES = 64 * 2**20  # of a message that is not
MESSAGE_TIMEOUT_S = 10.0  # from the first byte of a message to its last
SEND_TIMEOUT_S = 30.0
_SKIP_BYTES = 64 * 1024

_ACCEPTED, _REFUSED = b"\0", b"\1"
_MANY_POSES = ("TDATA", "QTDATA")  # types that tell those of several instruments

_log = logging.getLogger("ultragray.igtl")


class Connection:
    """Reads messages, renders the newest pose of each device, one after another, and sends."""

    def __init__(
        self,
        service: Service,
        scenes: SceneChooser,
        newest: Callable[[], Frame | None],
        publish: Callable[[Frame, Connection], None],
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
    ) -> None:
        """`newest`: the newest frame that the caller may see; `publish`: shows one to all who may see it."""
        self.feed = Feed(self._turn, self._send)
        self.record = OpenStream("openigtlink")
        self._answers = 0
        self._service, self._scenes = service, scenes
        self._newest_of_all, self._publish = newest, publish
        thickness_mm = service.settings.igtl_slice_thickness_mm
        setup = Setup(FrameSettings(slice_thickness_mm=thickness_mm), service.settings.igtl_registration)
        self._scanner = Scanner(scenes, service.registrations, setup)
        self._reader, self._writer = reader, writer
        self._sending = asyncio.Lock()
        self._showing = asyncio.Lock()
        self._poses = WaitingPoses()
        self._newest: PoseMessage | None = None  # of a probe
        hold_little(writer.transport)
        self._unread = Unread(writer.transport)

    async def run(self) -> None:
        work = [asyncio.ensure_future(self._render()), asyncio.ensure_future(self.feed.run())]
        try:
            while True:
                await self._take_message()
                await asyncio.sleep(0)  # reading does not wait while the buffer is full: others get their turn
        except IgtlMessageInvalid as error:
            self.dismiss(error)
        except (asyncio.IncompleteReadError, ConnectionError):
            pass
        finally:
            for task in work:
                task.cancel()
            await asyncio.gather(*work, return_exceptions=True)
            self._writer.close()

    async def settled(self) -> None:
        """Waits until every pose so far was answered or replaced."""
        await self._poses.settled()

    def dismiss(self, error: UltragrayError) -> None:
        """Tells the client why it cannot stay, and closes when it has taken what was sent."""
        if not self._writer.transport.is_closing():
            self._writer.write(pack_message(_refusal(Message("", ""), error)))
            self._writer.close()

    def abort(self) -> None:
        self._writer.transport.abort()

    async def _take_message(self) -> None:
        first_byte = await self._reader.readexactly(1)
        slow = asyncio.get_running_loop().call_later(MESSAGE_TIMEOUT_S, self.abort)
        try:
            header = unpack_header(first_byte + await self._reader.readexactly(HEADER_BYTES - 1))
            if header.body_bytes > MAX_SKIPPED_BYTES:
                raise _too_large(header, MAX_SKIPPED_BYTES)
            is_read = header.type_name in UNDERSTOOD and header.body_bytes <= MAX_BODY_BYTES
            if is_read:
                body = await self._reader.readexactly(header.body_bytes)
            else:
                body = None
                await self._skip(header)
        finally:
            slow.cancel()
        await self._answer(header, body, time.perf_counter())

    async def _skip(self, header: Header) -> None:
        rest_bytes = header.body_bytes
        while rest_bytes:
            chunk = await self._reader.read(min(rest_bytes, _SKIP_BYTES))
            if not chunk:
                raise asyncio.IncompleteReadError(b"", rest_bytes)
            rest_bytes -= len(chunk)

    async def _answer(self, header: Header, body: bytes | None, arrived: float) -> None:
        about = Message(header.type_name, header.device_name, timestamp=header.timestamp, version=header.version)
        try:
            if body is not None:
                about = unpack_message(header, body)
                await self._obey(about, arrived)
            elif header.type_name in UNDERSTOOD:
                raise _too_large(header, MAX_BODY_BYTES)
            elif header.type_name.startswith(("STT_", "STP_")):
                await self._send(_reply(f"RTS_{header.type_name[4:]}", about, _REFUSED))
            elif not header.type_name.startswith(HEARD):
                raise IgtlMessageInvalid(
                    f"the type must be one of {', '.join(CAPABILITY)}, got {header.type_name!r}", field="header"
                )
        except UltragrayError as error:
            await self._refuse(about, error, arrived)

    async def _obey(self, message: Message, arrived: float) -> None:
        prefix, suffix = message.type_name[:4], message.type_name[4:]
        if message.type_name in POSE_TYPES:
            await self._take_poses(message, arrived)
        elif message.type_name in COMMAND_TYPES:
            await self._send(await answer(self._scanner, message))
        elif message.type_name == "GET_CAPABIL":
            await self._send(_reply("CAPABILITY", message, pack_capability(CAPABILITY)))
        elif message.type_name == "GET_STATUS":
            self._service.rendering.require_frames()
            await self._send(_reply("STATUS", message, pack_status(Status(OK, 0, "OK", "ready"))))
        elif prefix == "GET_":
            await self._send(await self._newest_frame(KINDS[suffix], message))
        else:
            if prefix == "STT_":
                await self._subscribe(KINDS[suffix], message)
            else:
                self.feed.stop(KINDS[suffix])
            await self._send(_reply(f"RTS_{suffix}", message, _ACCEPTED))

    async def _subscribe(self, kind: str, query: Message) -> None:
        encoder = None
        if kind == "VIDEO":
            codec, interval_s = unpack_video_query(query.content)
            encoder = await asyncio.to_thread(VideoEncoder, codec)
        else:
            interval_s = unpack_interval_s(query.content)
        self.feed.start(kind, query.device_name, interval_s, query.version, encoder)

    async def _newest_frame(self, kind: str, query: Message) -> Message:
        """The newest frame as the query wants it; without content where there is none of that name."""
        encoder = await asyncio.to_thread(VideoEncoder) if kind == "VIDEO" else None
        frame = self._newest_of_all()
        if frame is None or not frame.goes_by(query.device_name):
            return _reply(kind, query, b"")
        return await asyncio.to_thread(frame.message, kind, query.version, query.message_id, query.device_name, encoder)

    async def _take_poses(self, message: Message, arrived: float) -> None:
        """Moves tools of devices, takes poses of others; where only tools moved, the last pose is rendered again."""
        tools = self._scanner.setup.tools
        if message.type_name == "TRANSFORM":
            poses = [(message.device_name, unpack_transform(message.content))]
        elif message.type_name == "POSITION":
            poses = [(message.device_name, unpack_position(message.content))]
        else:
            instruments = unpack_instruments(message.type_name, message.content, tools.are_moved_by)
            poses = [(one.name, one.pose) for one in instruments]
        of_tools = [(name, pose) for name, pose in poses if tools.are_moved_by(name)]
        of_probes = [(name, pose) for name, pose in poses if not tools.are_moved_by(name)]
        if message.type_name in _MANY_POSES:
            named = [(name, pose) for name, pose in of_probes if await self._scenes.named(name) is not None]
            of_probes = named or of_probes[:1]
        measured_s = message.timestamp / TICKS_PER_S or service_time_s()
        for device_name, pose in of_tools:
            self._scanner.move(device_name, pose)
        for device_name, pose in of_probes:
            self.record.count_pose()
            there, prediction = self._scanner.foretell(device_name, measured_s, pose)
            about = replace(message, device_name=device_name)
            self._newest = PoseMessage(about, there, arrived, prediction=prediction)
            if self._poses.put(self._newest, self._service.planner.deadline(None), self._scanner.setup):
                self._service.metrics.count_dropped()
        if of_tools and not of_probes and self._newest is not None:
            about = replace(message, device_name=self._newest.message.device_name)
            self._poses.again(PoseMessage(about, self._newest.pose, arrived))

    @asynccontextmanager
    async def _turn(self) -> AsyncIterator[None]:
        """The turn of a subscription to tell its newest frame: at most the one before is unread."""
        async with self._showing:
            await self._unread.all_but_one()
            yield

    async def _render(self) -> None:
        while True:
            await self._poses.come()
            await self._service.limits.frame_turn(None)  # meanwhile newer poses replace those that wait
            async with self._showing:
                await self._unread.none()
                await self._show(self._poses.take())

    async def _show(self, underway: Underway) -> None:
        try:
            frame = await render_frame(self._service, self._scenes, self._scanner, underway)
        except UltragrayError as error:
            self._note(underway.posed, error)
            await self._refuse(underway.posed.message, error, underway.posed.arrived)
        except Exception:
            _log.exception("unexpected error at a pose")
            unexpected = UltragrayError("an unexpected error, see the log")
            await self._refuse(underway.posed.message, unexpected, underway.posed.arrived)
        else:
            self._publish(frame, self)
            self._note(frame.posed, frame.result)
            request = frame.posed.message
            if not self.feed.films(frame):
                await self._send(frame.message("IMAGE", request.version, request.message_id))
            self._count(request.type_name, "OK", frame.posed.arrived)

    def _note(self, posed: PoseMessage, outcome: RenderResult | UltragrayError) -> None:
        self.record.name = posed.message.device_name
        self._answers += 1
        self.record.note(StreamAnswer(self._answers, None, outcome, posed.replaced))

    async def _refuse(self, about: Message, error: UltragrayError, arrived: float) -> None:
        self._service.metrics.count_frame_error(error)
        await self._send(_refusal(about, error))
        self._count(about.type_name, error.reason, arrived)

    def _count(self, type_name: str, status: str, arrived: float) -> None:
        route = type_name if type_name in UNDERSTOOD else "other"
        self._service.metrics.count_request("igtl", route, status, time.perf_counter() - arrived)

    async def _send(self, message: Message) -> None:
        async with self._sending:
            self._unread.write(pack_message(message))
            stalled = asyncio.get_running_loop().call_later(SEND_TIMEOUT_S, self.abort)
            try:
                await self._writer.drain()
            finally:
                stalled.cancel()


def _reply(type_name: str, to: Message, content: bytes) -> Message:
    return Message(type_name, to.device_name, content, to.timestamp, to.version, to.message_id)


def _refusal(about: Message, error: UltragrayError) -> Message:
    return _reply("STATUS", about, pack_status(state_of(error)))


def _too_large(header: Header, limit_bytes: int) -> IgtlMessageInvalid:
    return IgtlMessageInvalid(
        f"{header.type_name}: a body may hold at most {limit_bytes} bytes, got {header.body_bytes}", field="header"
    )
