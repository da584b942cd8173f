"""The process of the service: opens the doors, tells where they are, brings its worker along, and drains at a stop."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import gc
import logging
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Awaitable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from typing import Any

import uvloop

from ultragray_service.access.principals import is_loopback
from ultragray_service.doors import Doors
from ultragray_service.http.app import create_app
from ultragray_service.http.protocol import HttpServer
from ultragray_service.igtl.server import IgtlServer
from ultragray_service.listening import (
    Connections,
    OpenSockets,
    authority,
    check_port_is_free,
    listen,
    raise_open_files_limit,
)
from ultragray_service.misspelt import unknown_variables
from ultragray_service.rpc.server import GrpcServer
from ultragray_service.settings import ENVIRONMENT_PREFIX, Settings
from ultragray_service.telemetry.logs import configure_logging, is_for_people
from ultragray_service.tls import CertificateWatch
from ultragray_service.wiring import make_service
from ultragray_workers.errors import StartupFailed
from ultragray_workers.rounds import Rounds, repeat

_FIRST_WAIT_S, _LONGEST_WAIT_S = 0.5, 30.0
_STEADY_S = 60.0  # a worker that lived so long is started again after the first wait
_STOP_WAIT_S = 20.0  # beside what a job has to end
_PASSED_ON = (
    "data_folder",
    "artifact_folder",
    "cache_folder",
    "max_cache_bytes",
    "database_url",
    "training_threads",
    "job_nice",
    "max_footprint_pixels",
    "job_drain_timeout_s",
    "job_retention_days",
    "log_format",
    "log_level",
)

_log = logging.getLogger("ultragray.service")


class EmbeddedWorker:
    """Its methods belong to the event loop's thread, which must be the main one: the worker dies with it."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._stop = asyncio.Event()
        self._process: subprocess.Popen[bytes] | None = None
        self._task: asyncio.Task[None] | None = None
        self._thread = ThreadPoolExecutor(1, "embedded-worker")  # not the loop's, which others need

    def start(self) -> None:
        if self._settings.embedded_worker:
            self._task = asyncio.create_task(self._keep_alive())

    async def stop(self) -> None:
        self._stop.set()
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
        if self._task is None:
            return
        try:
            await asyncio.wait({self._task}, timeout=_STOP_WAIT_S + self._settings.job_drain_timeout_s)
        finally:  # also where the caller was cancelled
            if self._process is not None and self._process.poll() is None:
                self._process.kill()
        await self._task

    async def _keep_alive(self) -> None:
        wait_s = _FIRST_WAIT_S
        rounds = Rounds("the watch over the worker for jobs", _log)
        while not self._stop.is_set():
            started = time.monotonic()
            with rounds.round():  # a process that cannot be started, for want of memory or files, can be later
                self._process = self._spawn()
                code = await asyncio.get_running_loop().run_in_executor(self._thread, self._process.wait)
                if self._stop.is_set():
                    return
                if time.monotonic() - started > _STEADY_S:
                    wait_s = _FIRST_WAIT_S
                _log.warning(f"the worker for jobs ended with {code}; the next one starts in {wait_s:g} s")
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._stop.wait(), wait_s)
            wait_s = min(2.0 * wait_s, _LONGEST_WAIT_S)

    def _spawn(self) -> subprocess.Popen[bytes]:
        values = {name: getattr(self._settings, name) for name in _PASSED_ON}
        exports = {ENVIRONMENT_PREFIX + name.upper(): str(value) for name, value in values.items() if value is not None}
        # Not asyncio's: it forks, which gRPC complains about.
        return subprocess.Popen(
            [sys.executable, "-m", "ultragray_service.cli.worker", str(os.getpid())],
            stdin=subprocess.DEVNULL,
            env={**os.environ, **exports, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
            start_new_session=True,  # Ctrl-C is for the service, which then stops the worker
        )


# The words that systemd understands: the process is ready, still alive, stopping. Without systemd they go nowhere.
# A unit of `Type=notify` names a socket in NOTIFY_SOCKET; one with `WatchdogSec` expects a word within that time, and
# restarts a process from which it hears none.
READY, ALIVE, STOPPING = "READY=1", "WATCHDOG=1", "STOPPING=1"
_WORDS_WITHIN_TIMEOUT = 3


class ServiceManager:
    def __init__(self) -> None:
        """Takes its variables out of the environment: they are not for processes that this one starts."""
        address = os.environ.pop("NOTIFY_SOCKET", "")
        self._address = f"\0{address[1:]}" if address.startswith("@") else address  # of Linux's abstract names
        timeout_us, pid = os.environ.pop("WATCHDOG_USEC", ""), os.environ.pop("WATCHDOG_PID", "")
        is_watched = timeout_us.isdigit() and pid in ("", str(os.getpid()))
        # Seconds between two words that the process is alive; None: nobody waits for them.
        self.alive_every_s = int(timeout_us) / 1e6 / _WORDS_WITHIN_TIMEOUT if is_watched and self._address else None

    def tell(self, word: str) -> None:
        """Sends READY, ALIVE or STOPPING. Does not block: one that is too busy to listen is told the next time."""
        if self._address:
            with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as sender:
                sender.sendto(word.encode(), self._address)

    async def tell_alive(self) -> None:
        while self.alive_every_s is not None:
            self.tell(ALIVE)
            await asyncio.sleep(self.alive_every_s)


_HEALTH_POLL_S = 0.2
_CANCEL_WAIT_S = 1.0
_FLUSH_S = 2  # for the last bytes of answers, after the last frame
_M_MMAP_THRESHOLD = -3  # of malloc.h
_M_TRIM_THRESHOLD = -1
_LARGE_BLOCK_BYTES = 8 * 2**20
_KEPT_BYTES = 64 * 2**20  # at the end of the heap
_LOOPBACK = "127.0.0.1"
_DOORS = 3
_OTHER_FILES = 1024


def run(settings: Settings) -> None:
    configure_logging(settings.log_level, settings.log_format)
    for sentence in unknown_variables():
        _log.warning(sentence)
    _return_large_blocks()
    raise_open_files_limit(_DOORS * settings.max_connections + _OTHER_FILES)
    uvloop.run(serve(settings))


async def serve(settings: Settings) -> None:
    """Serve HTTP, gRPC and, where it has a port, OpenIGTLink, until SIGTERM or SIGINT.

    Then drains: ready turns false, after `drain_delay_s` nothing new is taken, and what waits is answered. A second
    signal stops at once.
    Raises StartupFailed: a port in use, no data folder, a bad preload, certificates that cannot be used, other machines
    served without API keys.
    """
    signals = _StopSignals()
    manager = ServiceManager()
    certificates = CertificateWatch.of(settings)
    service = make_service(settings)
    if certificates is not None:
        service.metrics.tell_certificate_expiry(lambda: certificates.current.not_after)
    await service.open()
    grpc_server = GrpcServer(service)
    app = create_app(service)  # before any port is taken: who connects to one that does not answer yet would wait
    grpc_port = _bind_grpc(grpc_server, settings, certificates)
    igtl_server = IgtlServer(service)
    with contextlib.ExitStack() as sockets:
        http_socket = sockets.enter_context(listen(settings.host, settings.http_port, "HTTP", "http_port"))
        igtl = await _start_igtl(igtl_server, settings, sockets)
        service.doors = Doors.of(settings, http_socket.getsockname()[1], grpc_port, igtl)
        http_server = HttpServer(app, settings, service.metrics, certificates, _FLUSH_S)
        await grpc_server.start()
        http_task = asyncio.ensure_future(http_server.serve([http_socket]))
        alive_task = asyncio.ensure_future(manager.tell_alive())
        mirror_health = partial(grpc_server.tell_health, service.readiness)
        cap = Connections(settings.max_connections, settings.max_connections_per_address)  # gRPC accepts by itself
        watching = [
            asyncio.ensure_future(repeat("the health of gRPC", _log, _HEALTH_POLL_S, mirror_health)),
            asyncio.ensure_future(OpenSockets(grpc_port, cap).run()),
        ]
        if certificates is not None:
            watching.append(asyncio.ensure_future(certificates.follow()))
        _log.info(f"starting to serve the scenes of {settings.data_folder}")
        worker = EmbeddedWorker(settings)
        try:
            if await _unless(signals.stop, service.start()):
                worker.start()
                gc.freeze()  # what lives this long is never garbage: shorter pauses
                _tell_where(service.doors, service.guard.asks)
                manager.tell(READY)
                await signals.stop.wait()
            manager.tell(STOPPING)
            if settings.drain_delay_s:
                service.life.begin_leaving()
                _log.info(f"not ready any more; stopping in {settings.drain_delay_s:g} s")
                await _unless(signals.force, asyncio.sleep(settings.drain_delay_s))
            _log.info("stopping: frames that wait are answered first; Ctrl-C again stops at once")
        finally:
            for task in watching:
                task.cancel()
            service.begin_draining()
            worker_stop = asyncio.ensure_future(worker.stop())
            await grpc_server.tell_health(service.readiness)
            await _unless(signals.force, service.pool.drain(settings.drain_timeout_s))
            await service.pool.close()
            http_server.should_exit = True
            http_server.force_exit = signals.force.is_set()
            await _unless(
                signals.force, asyncio.gather(grpc_server.stop(_FLUSH_S), igtl_server.stop(_FLUSH_S), http_task)
            )
            await _unless(signals.force, worker_stop)
            await service.close()
            alive_task.cancel()
    _log.info("stopped")


def _tell_where(doors: Doors, asks_for_keys: bool) -> None:
    if is_for_people(doors.settings.log_format):
        sys.stderr.write(doors.banner(asks_for_keys))
    else:
        _log.info(doors.in_words(), extra={"fields": doors.fields()})


def _return_large_blocks() -> None:
    """Make glibc hand freed blocks of 8 MiB and more back to the system; by itself it stops after the first ones.

    Smaller ones, such as frames, it keeps for the next: new pages cost more than what is written into them.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _LARGE_BLOCK_BYTES)
        mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)


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


async def _unless(event: asyncio.Event, work: Awaitable[Any]) -> bool:
    """Await `work` and return True; False where the event came first and cancelled it."""
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


def _bind_grpc(server: GrpcServer, settings: Settings, certificates: CertificateWatch | None) -> int:
    check_port_is_free(settings.host, settings.grpc_port, "gRPC", "grpc_port")  # gRPC would print lines of its own
    try:
        return server.bind(settings.host, settings.grpc_port, certificates)
    except RuntimeError as error:  # somebody was faster
        raise StartupFailed(
            f"gRPC cannot listen on {authority(settings.host, settings.grpc_port)}: the port is in use",
            field="grpc_port",
        ) from error


async def _start_igtl(server: IgtlServer, settings: Settings, sockets: contextlib.ExitStack) -> str | None:
    if settings.igtl_port is None:
        return None
    host = _LOOPBACK if server.is_local and not is_loopback(settings.host) else settings.host
    listener = sockets.enter_context(listen(host, settings.igtl_port, "OpenIGTLink", "igtl_port"))
    port = int(listener.getsockname()[1])
    await server.start(listener)
    return authority(host, port)
