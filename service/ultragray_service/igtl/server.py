"""The OpenIGTLink front door: who is connected, and the frames that they share."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import time

from ultragray_workers.errors import Draining, QueueFull

from ..core.state import Service
from .connection import SEND_TIMEOUT_S, Connection
from .frames import Frame
from .routes import SceneChooser

MAX_CONNECTIONS = 512

_log = logging.getLogger("ultragray.igtl")


class IgtlServer:
    """A server that listens once started. Keeps the newest frame of all clients, for those who ask for it."""

    def __init__(self, service: Service) -> None:
        self.newest: Frame | None = None
        self._service = service
        self._scenes = SceneChooser(service.catalog, service.settings.igtl_scene)
        self._connections: dict[Connection, asyncio.Task[None]] = {}
        self._server: asyncio.Server | None = None

    async def start(self, listener: socket.socket) -> None:
        """Begins to answer on a bound socket."""
        self._server = await asyncio.start_server(self._connected, sock=listener)

    async def stop(self, grace_s: float) -> None:
        """Lets what is being answered be answered, tells every client that the service stops, and closes.

        Each may take `grace_s` seconds.
        """
        if self._server is None:
            return
        self._server.close()
        connections = dict(self._connections)
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(asyncio.gather(*(one.settled() for one in connections)), grace_s)
        for connection in connections:
            connection.dismiss(Draining("the service is stopping"))
        if connections:
            await asyncio.wait(connections.values(), timeout=grace_s)
        for connection in self._connections:
            connection.abort()

    def publish(self, frame: Frame, source: Connection) -> None:
        """Tells every client about a frame that was rendered for `source`."""
        self.newest = frame
        for connection in self._connections:
            connection.feed.offer(frame, is_own=connection is source)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        connection = Connection(self._service, self._scenes, self, reader, writer)
        if len(self._connections) >= MAX_CONNECTIONS:
            connection.dismiss(QueueFull(f"at most {MAX_CONNECTIONS} clients may be connected"))
            return
        if (endpoint := writer.get_extra_info("socket")) is not None:
            endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)  # to notice a peer that has vanished
        started = time.monotonic()
        client = str(writer.get_extra_info("peername"))
        task = asyncio.ensure_future(connection.run())
        self._connections[connection] = task
        try:
            await task
        except Exception:
            _log.exception("unexpected error", extra={"fields": {"client": client}})
        finally:
            stalled = asyncio.get_running_loop().call_later(SEND_TIMEOUT_S, connection.abort)
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()
            stalled.cancel()
            del self._connections[connection]
            fields = {"client": client, "duration_ms": round(1000 * (time.monotonic() - started), 3)}
            _log.info("client gone", extra={"fields": fields})
