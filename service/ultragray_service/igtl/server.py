"""The OpenIGTLink front door: who is connected, and the frames that they share."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import time

from ultragray.errors import UltragrayError
from ultragray_service.access.audit import NOBODY, Entry
from ultragray_service.access.owners import may_see
from ultragray_service.access.principals import LOCAL, AddressRoles, Principal, act_as, acting
from ultragray_service.access.rules import IGTL
from ultragray_service.errors import LimitReached, PermissionDenied, RateLimited, TooManyConnections, Unauthenticated
from ultragray_service.igtl.connection import SEND_TIMEOUT_S, Connection
from ultragray_service.igtl.frames import Frame
from ultragray_service.igtl.routes import SceneChooser
from ultragray_service.listening import Connections
from ultragray_service.service import Service
from ultragray_workers.errors import Draining
from ultragray_workers.jobs.owners import Kind

_log = logging.getLogger("ultragray.igtl")


class IgtlServer:
    """A server that listens once started. Keeps the newest frame of all clients, for those who ask for it."""

    def __init__(self, service: Service) -> None:
        # The newest frames last, by whom their scenes are private to; None: they are not.
        self._frames: dict[str | None, Frame] = {}
        self._service = service
        self._roles = AddressRoles(service.settings.igtl_allow)
        self._places = Connections(service.settings.max_connections, service.settings.max_connections_per_address)
        self._connections: dict[Connection, asyncio.Task[None]] = {}
        self._principals: dict[Connection, Principal] = {}
        self._server: asyncio.Server | None = None

    @property
    def is_local(self) -> bool:
        return self._roles.is_local

    async def start(self, listener: socket.socket) -> None:
        self._server = await asyncio.start_server(self._connected, sock=listener)

    async def stop(self, grace_s: float) -> None:
        """Lets what is being answered be answered, each within `grace_s`, tells every client, and closes."""
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

    def newest(self) -> Frame | None:
        return next((frame for frame in reversed(self._frames.values()) if self._may_see(acting(), frame)), None)

    def publish(self, frame: Frame, source: Connection) -> None:
        kept_for = frame.ownership.owner if frame.ownership.private else None
        self._frames.pop(kept_for, None)
        self._frames[kept_for] = frame
        for connection, principal in self._principals.items():
            if self._may_see(principal, frame):
                connection.feed.offer(frame, is_own=connection is source)

    def _may_see(self, principal: Principal, frame: Frame) -> bool:
        now = self._service.owners.known(Kind.SCENE, frame.result.scene)
        return may_see(principal, frame.ownership) and may_see(principal, now)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        # Its own: a client knows the scenes that it may see.
        scenes = SceneChooser(self._service.catalog, self._service.settings.igtl_scene)
        connection = Connection(self._service, scenes, self.newest, self.publish, reader, writer)
        host, port, *_ = writer.get_extra_info("peername") or ("::", 0)  # none of a peer that has gone already
        principal = self._roles.principal_of(host, asks=self._service.guard.asks)
        if principal is None:
            self._service.audit.count(Entry(NOBODY, host, IGTL.name, "", PermissionDenied.reason))
            connection.dismiss(PermissionDenied(f"{host} may not connect: ULTRAGRAY_IGTL_ALLOW does not name it"))
            return
        act_as(principal, address=host, connection=f"{host}:{port}")
        with contextlib.ExitStack() as places:
            try:
                self._service.limits.take_request()
                places.enter_context(self._places.enter(host))
                places.enter_context(self._service.limits.stream())
                connection.record = places.enter_context(self._service.streams.opened("openigtlink", ""))
            except (TooManyConnections, RateLimited, LimitReached) as error:
                self._service.audit.count(Entry(principal.name, host, IGTL.name, "", error.reason))
                connection.dismiss(error)
                return
            await self._serve(connection, writer, principal, host)

    async def _run(self, connection: Connection, task: asyncio.Task[None], principal: Principal) -> None:
        """Waits for the end of a connection. Raises Unauthenticated where everybody's rights end with the first key."""
        session = self._service.sessions.held(LOCAL, None) if principal is LOCAL else contextlib.nullcontext()
        try:
            with session:
                await asyncio.shield(task)
        except UltragrayError as error:
            connection.dismiss(error)
            raise
        finally:
            task.cancel()

    async def _serve(
        self, connection: Connection, writer: asyncio.StreamWriter, principal: Principal, host: str
    ) -> None:
        if (endpoint := writer.get_extra_info("socket")) is not None:
            endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)  # to notice a peer that has vanished
        started = time.monotonic()
        client = str(writer.get_extra_info("peername"))
        task = asyncio.ensure_future(connection.run())
        self._connections[connection] = task
        self._principals[connection] = principal
        try:
            with self._service.audit.request(principal.name, host, IGTL, ""):
                await self._run(connection, task, principal)
        except Unauthenticated:
            pass  # the client was told
        except Exception:
            _log.exception("unexpected error", extra={"fields": {"client": client}})
        finally:
            stalled = asyncio.get_running_loop().call_later(SEND_TIMEOUT_S, connection.abort)
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()
            stalled.cancel()
            del self._connections[connection], self._principals[connection]
            fields = {"client": client, "duration_ms": round(1000 * (time.monotonic() - started), 3)}
            _log.info("client gone", extra={"fields": fields})
