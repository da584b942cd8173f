"""The WebSocket as streams need it: a message that was sent has left the service."""

from __future__ import annotations

import asyncio
from typing import Any

from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from ..core.streams.buffers import hold_little


class PromptWebSocket(WebSocketsSansIOProtocol):
    """A WebSocket that buffers next to nothing: whoever sends waits until the kernel has taken the whole message."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        hold_little(transport)

    async def send(self, message: Any) -> None:
        await super().send(message)
        await self.writable.wait()
