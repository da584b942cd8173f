"""The WebSocket as streams need it: a message that was sent has left the service, or is in the hands of the client."""

from __future__ import annotations

import asyncio
from typing import Any

from uvicorn.protocols.utils import ClientDisconnected
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.exceptions import InvalidState
from websockets.frames import Frame

from ultragray_service.core.streams.buffers import hold_little

HAND_OVER = "ultragray.hand_over"  # of an ASGI message with bytes: to return once the client has taken it
_FRAGMENTS = 32  # of a message that is handed over
_PINGS = 2
_LOOK_EVERY_S = 0.25


class PromptWebSocket(WebSocketsSansIOProtocol):
    """A WebSocket that buffers next to nothing: whoever sends waits until the kernel has taken the whole message.

    A message that is handed over waits longer, for pongs. Some libraries answer pings when the caller reads, which
    suffices; others read ahead until so many fragments (Python's websockets: 16) wait for the caller, which every
    message therefore has more than. Such a library may still read a ping that comes together with the message; it has
    stopped when the next one comes.
    """

    _pong: asyncio.Future[None] | None = None
    _ping = 0  # the number of the last one, which it carries

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        hold_little(transport)

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._answered()

    def handle_pong(self, event: Frame) -> None:
        if bytes(event.data) == self._ping_payload:
            self._answered()
        else:
            super().handle_pong(event)

    async def send(self, message: Any) -> None:
        is_handed_over = message.get(HAND_OVER, False)
        try:
            if not is_handed_over or "bytes" not in message:
                await super().send(message)
                await self.writable.wait()
                return
            self._send_fragments(message["bytes"])
            await self.writable.wait()
            for _ in range(_PINGS):
                await self._be_answered()
        except InvalidState:
            raise ClientDisconnected from None

    def _send_fragments(self, data: bytes) -> None:
        step = -(-len(data) // _FRAGMENTS)
        self.conn.send_binary(data[:step], fin=False)
        for start in range(step, len(data), step):
            self.conn.send_continuation(data[start : start + step], fin=start + step >= len(data))
        self._write()

    async def _be_answered(self) -> None:
        """Waits for the pong of a new ping, or for the end of the connection.

        Not while nobody reads on, such as a stream with too many refusals to send: the pong is behind what is unread.
        """
        self._pong = self.loop.create_future()
        self._ping += 1
        self.conn.send_ping(self._ping_payload)
        self._write()
        while not self._pong.done():
            was_paused = self.read_paused
            await asyncio.wait({self._pong}, timeout=_LOOK_EVERY_S)
            if was_paused and self.read_paused:
                return

    @property
    def _ping_payload(self) -> bytes:
        return b"taken %d" % self._ping

    def _answered(self) -> None:
        if self._pong is not None and not self._pong.done():
            self._pong.set_result(None)

    def _write(self) -> None:
        self.transport.write(b"".join(self.conn.data_to_send()))
