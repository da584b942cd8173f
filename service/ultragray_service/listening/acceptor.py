"""Accepting connections, each of which has a place before anything of it is read."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import ssl
from collections.abc import Callable

from ultragray_service.errors import TooManyConnections
from ultragray_service.listening.connections import Connections, Place
from ultragray_service.listening.sockets import give_up_on_silent_peers
from ultragray_service.tls.certificates import HANDSHAKE_TIMEOUT_S
from ultragray_workers.rounds import Rounds

_RETRY_S = 0.1  # where there is no file descriptor for another connection

_log = logging.getLogger("ultragray.service")


class Acceptor:
    """Accepts from a socket that listens, until it is closed."""

    def __init__(
        self,
        listener: socket.socket,
        connections: Connections,
        protocol: Callable[[Place], asyncio.Protocol],
        *,
        refusal: Callable[[TooManyConnections], bytes],
        send_patience_s: float,
        tls: Callable[[], ssl.SSLContext | None],
    ) -> None:
        """`protocol` serves a connection and gives its place back; `refusal` is sent to one that gets none.

        `tls` is asked for each connection, so that new ones get a new certificate.
        """
        self._listener = listener
        self._connections = connections
        self._protocol = protocol
        self._refusal = refusal
        self._send_patience_s = send_patience_s
        self._tls = tls
        self._serving: set[asyncio.Task[None]] = set()
        self._task = asyncio.ensure_future(self._accept())

    def close(self) -> None:
        """Accepts nothing more; what was accepted stays."""
        self._task.cancel()

    async def wait_closed(self) -> None:
        """Returns when nothing is being accepted any more."""
        await asyncio.wait({self._task})

    async def _accept(self) -> None:
        rounds = Rounds("accepting connections", _log)
        while True:
            with rounds.round():
                await self._accept_one()

    async def _accept_one(self) -> None:
        try:
            connection, peer = await asyncio.get_running_loop().sock_accept(self._listener)
        except OSError as error:  # too many open files, or a peer that has gone already
            _log.warning(f"a connection could not be accepted: {error.strerror}")
            await asyncio.sleep(_RETRY_S)
            return
        try:
            place = self._connections.enter(peer[0])
        except TooManyConnections as error:
            self._refuse(connection, error)
            return
        task = asyncio.ensure_future(self._serve(connection, place))
        self._serving.add(task)
        task.add_done_callback(self._serving.discard)

    def _refuse(self, connection: socket.socket, error: TooManyConnections) -> None:
        with connection, contextlib.suppress(OSError):  # before TLS no answer can be read
            if self._tls() is None:
                connection.send(self._refusal(error))
                connection.shutdown(socket.SHUT_WR)

    async def _serve(self, connection: socket.socket, place: Place) -> None:
        tls = self._tls()
        timeout_s = None if tls is None else HANDSHAKE_TIMEOUT_S
        is_served = False
        try:
            give_up_on_silent_peers(connection, self._send_patience_s)
            await asyncio.get_running_loop().connect_accepted_socket(
                lambda: self._protocol(place), connection, ssl=tls, ssl_handshake_timeout=timeout_s
            )
            is_served = True
        except OSError:
            pass  # the peer has gone, or its TLS handshake failed
        finally:
            if not is_served:
                place.leave()
                connection.close()
