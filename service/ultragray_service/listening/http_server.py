"""uvicorn, with connections of ours."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import ssl
from collections.abc import Iterator
from typing import Any

import uvicorn
from starlette.types import ASGIApp

from ultragray.errors import UltragrayError
from ultragray_service.errors import statuses_of
from ultragray_service.http.prompt_websocket import PromptWebSocket
from ultragray_service.listening.acceptor import Acceptor
from ultragray_service.listening.connections import Connections, Place
from ultragray_service.listening.http_protocol import BoundedHttp, HttpLimits, refusal_bytes
from ultragray_service.settings import Settings
from ultragray_service.telemetry.metrics import Metrics
from ultragray_service.tls.watch import CertificateWatch

MAX_STREAM_MESSAGE_BYTES = 2**16  # of a client, on a WebSocket
_TICKS_PER_LOOK = 10  # of 0.1 s


class HttpServer(uvicorn.Server):
    """Serves an application. Has no signal handlers: one place decides when all servers stop."""

    def __init__(
        self, app: ASGIApp, settings: Settings, metrics: Metrics, certificates: CertificateWatch | None, flush_s: float
    ) -> None:
        """`flush_s`: how long the last answers may take after a stop."""
        super().__init__(
            uvicorn.Config(
                app,
                http=BoundedHttp,
                ws=PromptWebSocket,
                ws_max_size=MAX_STREAM_MESSAGE_BYTES,
                ws_per_message_deflate=False,  # speckle does not shrink
                lifespan="off",
                log_config=None,
                access_log=False,
                server_header=False,
                proxy_headers=False,  # anybody on this machine could write another's address there
                timeout_keep_alive=int(settings.idle_timeout_s),
                timeout_graceful_shutdown=int(flush_s),
            )
        )
        self._settings = settings
        self._metrics = metrics
        self._certificates = certificates
        self._limits = HttpLimits(
            max_header_bytes=settings.max_header_bytes,
            max_headers=settings.max_headers,
            header_timeout_s=settings.header_timeout_s,
            min_bytes_per_s=settings.min_bytes_per_s,
            transfer_patience_s=settings.transfer_patience_s,
            on_refused=self._count,
        )

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begins to accept. uvicorn's own would not know whom it accepts."""
        connections = Connections(self._settings.max_connections, self._settings.max_connections_per_address)
        servers: list[Any] = [
            Acceptor(
                listener,
                connections,
                self._protocol,
                refusal=self._refusal,
                send_patience_s=self._settings.transfer_patience_s,
                tls=self._tls,
            )
            for listener in sockets or ()
        ]
        self.servers = servers
        self.started = True

    async def on_tick(self, counter: int) -> bool:
        """Every 0.1 s."""
        if counter % _TICKS_PER_LOOK == 0:
            now = asyncio.get_running_loop().time()
            connections: set[Any] = self.server_state.connections
            for connection in tuple(connections):
                connection.look(now)
        return await super().on_tick(counter)

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield

    def _tls(self) -> ssl.SSLContext | None:
        return None if self._certificates is None else self._certificates.current.http_context

    def _protocol(self, place: Place) -> BoundedHttp:
        return BoundedHttp(self.config, self.server_state, {}, limits=self._limits, place=place)

    def _refusal(self, error: UltragrayError) -> bytes:
        self._count(error)
        return refusal_bytes(error, self.server_state.default_headers)

    def _count(self, error: UltragrayError) -> None:
        self._metrics.count_request("http", "refused", str(statuses_of(error).http), 0.0)
