"""Both servers in one process on one event loop, from start to a clean stop."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import gc
import logging
import signal
import socket
from collections.abc import Awaitable, Iterator
from typing import Any, Literal

import uvicorn
import uvloop

from ultragray_workers.errors import StartupFailed

from .core.state import Service
from .embedded_worker import EmbeddedWorker
from .http.app import create_app
from .igtl.server import IgtlServer
from .rpc.server import GrpcServer
from .settings import ENVIRONMENT_PREFIX, Settings
from .telemetry.logs import configure_logging

_HEALTH_POLL_S = 0.2
_CANCEL_WAIT_S = 1.0
_FLUSH_S = 2  # for the last bytes of answers, after the last frame
_KEEP_ALIVE_S = 75
_M_MMAP_THRESHOLD = -3  # of malloc.h
_LARGE_BLOCK_BYTES = 2**20
MAX_STREAM_MESSAGE_BYTES = 2**16  # of a client, on a WebSocket
_BACKLOG = 2048

_log = logging.getLogger("ultragray.service")


def run(settings: Settings) -> None:
    """Serve until SIGTERM or SIGINT. Raises StartupFailed where it cannot start."""
    configure_logging(settings.log_level)
    _return_large_blocks()
    uvloop.run(serve(settings))


async def serve(settings: Settings) -> None:
    """Serve HTTP, gRPC and, where it has a port, OpenIGTLink, until SIGTERM or SIGINT.

    Then drains: ready turns false, what waits is answered. A second signal stops at once.
    Raises StartupFailed: a port in use, no data folder, a bad preload, API keys with OpenIGTLink.
    """
    signals = _StopSignals()
    service = Service(settings)
    grpc_server = GrpcServer(service)
    grpc_port = _bind_grpc(grpc_server, settings)
    igtl_server = IgtlServer(service)
    with contextlib.ExitStack() as sockets:
        http_socket = sockets.enter_context(_listen(settings, "HTTP", "http_port"))
        igtl_port = await _start_igtl(igtl_server, settings, sockets)
        http_server = _HttpServer(_http_config(service))
        await grpc_server.start()
        http_task = asyncio.ensure_future(http_server.serve([http_socket]))
        health_task = asyncio.ensure_future(_mirror_health(service, grpc_server))
        _log.info("starting the render processes")
        worker = EmbeddedWorker(settings)
        try:
            if await signals.unless_stopped(service.start()):
                worker.start()
                gc.freeze()  # what lives this long is never garbage: shorter pauses
                _tell_where(settings, http_socket.getsockname()[1], grpc_port, igtl_port)
                await signals.stop.wait()
            _log.info("stopping: frames that wait are answered first")
        finally:
            health_task.cancel()
            service.begin_draining()
            worker_stop = asyncio.ensure_future(worker.stop())
            await grpc_server.tell_health(serving=False)
            await signals.unless_forced(service.pool.drain(settings.drain_timeout_s))
            await service.pool.close()
            http_server.should_exit = True
            http_server.force_exit = signals.force.is_set()
            await signals.unless_forced(
                asyncio.gather(grpc_server.stop(_FLUSH_S), igtl_server.stop(_FLUSH_S), http_task)
            )
            await signals.unless_forced(worker_stop)
            await service.jobs.close()
    _log.info("stopped")


def _tell_where(settings: Settings, http_port: int, grpc_port: int, igtl_port: int | None) -> None:
    http = f"http://{_authority(settings.host, http_port)}"
    grpc = _authority(settings.host, grpc_port)
    fields = {"http": http, "grpc": grpc, "docs": f"{http}/docs", "data_folder": str(settings.data_folder)}
    message = f"serving HTTP on {http} (docs at {http}/docs) and gRPC on {grpc}"
    if igtl_port is not None:
        fields["igtl"] = _authority(settings.host, igtl_port)
        message += f", OpenIGTLink on {fields['igtl']}"
    _log.info(message, extra={"fields": fields})


def _return_large_blocks() -> None:
    """Make glibc hand freed blocks of a MiB and more back to the system; by itself it stops after the first ones."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _LARGE_BLOCK_BYTES)


class _StopSignals:
    """SIGTERM and SIGINT: the first asks to stop, the second to stop at once."""

    def __init__(self) -> None:
        self.stop = asyncio.Event()
        self.force = asyncio.Event()
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self._received)

    def _received(self) -> None:
        (self.force if self.stop.is_set() else self.stop).set()

    async def unless_stopped(self, work: Awaitable[Any]) -> bool:
        """Await `work` and return True; False where the first signal cancelled it."""
        return await _unless(self.stop, work)

    async def unless_forced(self, work: Awaitable[Any]) -> bool:
        """Await `work` and return True; False where the second signal cancelled it."""
        return await _unless(self.force, work)


async def _unless(event: asyncio.Event, work: Awaitable[Any]) -> bool:
    task = asyncio.ensure_future(work)
    waiting = asyncio.ensure_future(event.wait())
    try:
        await asyncio.wait({task, waiting}, return_when=asyncio.FIRST_COMPLETED)
        if task.done():
            task.result()
            return True
        task.cancel()
        await asyncio.wait({task}, timeout=_CANCEL_WAIT_S)
        return False
    finally:
        task.cancel()
        waiting.cancel()


class _HttpServer(uvicorn.Server):
    """uvicorn without signal handlers of its own: one place decides when both servers stop."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


def _http_config(service: Service) -> uvicorn.Config:
    return uvicorn.Config(
        create_app(service),
        http="httptools",
        ws="websockets-sansio",
        ws_max_size=MAX_STREAM_MESSAGE_BYTES,
        ws_per_message_deflate=False,  # speckle does not shrink
        lifespan="off",
        log_config=None,
        access_log=False,
        server_header=False,
        timeout_keep_alive=_KEEP_ALIVE_S,
        timeout_graceful_shutdown=_FLUSH_S,
    )


def _listen(settings: Settings, what: str, field: Literal["http_port", "igtl_port"]) -> socket.socket:
    host, port = settings.host, getattr(settings, field)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
    except OSError as error:
        listener.close()
        raise StartupFailed(
            f"{what} cannot listen on {_authority(host, port)}: {error.strerror}; "
            f"set {ENVIRONMENT_PREFIX}{field.upper()} to another port",
            field=field,
        ) from error
    listener.listen(_BACKLOG)
    listener.setblocking(False)
    return listener


def _bind_grpc(server: GrpcServer, settings: Settings) -> int:
    try:
        return server.bind(settings.host, settings.grpc_port)
    except RuntimeError as error:
        raise StartupFailed(
            f"gRPC cannot listen on {_authority(settings.host, settings.grpc_port)}: the port is in use "
            "or the address is not this machine's; set ULTRAGRAY_GRPC_PORT to another port",
            field="grpc_port",
        ) from error


async def _start_igtl(server: IgtlServer, settings: Settings, sockets: contextlib.ExitStack) -> int | None:
    """Begins to answer and returns the port; None where it has none."""
    if settings.igtl_port is None:
        return None
    if settings.api_keys:
        raise StartupFailed(
            "OpenIGTLink cannot ask for an API key: unset ULTRAGRAY_IGTL_PORT or ULTRAGRAY_API_KEYS", field="igtl_port"
        )
    listener = sockets.enter_context(_listen(settings, "OpenIGTLink", "igtl_port"))
    port = int(listener.getsockname()[1])
    await server.start(listener)
    return port


async def _mirror_health(service: Service, server: GrpcServer) -> None:
    """Keep the health of gRPC equal to the readiness of HTTP."""
    serving = False
    while True:
        if service.ready is not serving:
            serving = service.ready
            await server.tell_health(serving=serving)
        await asyncio.sleep(_HEALTH_POLL_S)


def _authority(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
