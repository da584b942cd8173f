"""Sockets that listen: who may connect, how many, and how long each may take.

Neither uvicorn nor gRPC counts connections by address. HTTP and OpenIGTLink are accepted here, a place for each; gRPC
accepts by itself, and is watched.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import os
import resource
import socket
import ssl
import stat
import sys
from collections import Counter
from collections.abc import Callable
from ipaddress import IPv6Address, ip_address

from ultragray_service.errors import TooManyConnections
from ultragray_service.settings import ENVIRONMENT_PREFIX
from ultragray_service.tls import HANDSHAKE_TIMEOUT_S
from ultragray_workers.errors import StartupFailed
from ultragray_workers.rounds import repeat

_IPV6_NETWORK_BITS = 64  # what one subscriber has


Place = contextlib.ExitStack  # of one connection; closing it, the first time, gives the place back


class Connections:
    def __init__(self, total: int, per_address: int) -> None:
        self._total, self._per_address = total, per_address
        self._by_address: Counter[str] = Counter()
        self._count = 0

    def enter(self, host: str) -> Place:
        address = address_of(host)
        if self._by_address[address] >= self._per_address:
            raise TooManyConnections(f"at most {self._per_address} connections of one address may be open")
        if self._count >= self._total:
            raise TooManyConnections(f"at most {self._total} connections may be open")
        self._count += 1
        self._by_address[address] += 1
        place = Place()
        place.callback(self._leave, address)
        return place

    def _leave(self, address: str) -> None:
        self._count -= 1
        self._by_address[address] -= 1
        if not self._by_address[address]:
            del self._by_address[address]


def address_of(host: str) -> str:
    """What counts as one address: an IPv4 address, or the network of an IPv6 one."""
    address = ip_address(host.partition("%")[0])
    if not isinstance(address, IPv6Address):
        return str(address)
    if address.ipv4_mapped is not None:
        return str(address.ipv4_mapped)
    return str(int(address) >> (128 - _IPV6_NETWORK_BITS))


_RETRY_S = 0.1  # where there is no file descriptor for another connection

_log = logging.getLogger("ultragray.service")


class Acceptor:
    def __init__(
        self,
        listener: socket.socket,
        connections: Connections,
        protocol: Callable[..., asyncio.Protocol],
        *,
        refusal: Callable[[TooManyConnections], bytes],
        send_patience_s: float,
        tls: Callable[[], ssl.SSLContext | None],
    ) -> None:
        """`protocol` serves a connection, `refusal` is sent to one without a place, `tls` is asked for each of them."""
        self._listener, self._connections, self._protocol = listener, connections, protocol
        self._refusal, self._send_patience_s, self._tls = refusal, send_patience_s, tls
        self._serving: set[asyncio.Task[None]] = set()
        self._task = asyncio.ensure_future(repeat("accepting connections", _log, 0.0, self._accept_one))

    def close(self) -> None:
        """Accepts nothing more; what was accepted stays."""
        self._task.cancel()

    async def wait_closed(self) -> None:
        await asyncio.wait({self._task})

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
                lambda: self._protocol(place=place), connection, ssl=tls, ssl_handshake_timeout=timeout_s
            )
            is_served = True
        except OSError:
            pass  # the peer has gone, or its TLS handshake failed
        finally:
            if not is_served:
                place.close()
                connection.close()


# A cap by address on connections that a library accepts by itself, as gRPC does.
# This process finds its own sockets among its open files, and shuts down those of an address that has too many: the
# library sees them end as if the peer had hung up. Connections that are known stay; new ones go.
INTERVAL_S = 0.25
_OPEN_FILES = "/dev/fd"


class OpenSockets:
    def __init__(self, port: int, connections: Connections) -> None:
        self._port, self._connections = port, connections
        self._others: set[int] = set()  # sockets that are no connections to the port, by inode
        self._places: dict[int, Place] = {}  # the connections, by inode

    async def run(self) -> None:
        async def look() -> None:
            if refused := await asyncio.to_thread(self.look):
                _log.warning(f"closed {refused} connections to port {self._port}: too many of one address")

        await repeat(f"the watch over connections to port {self._port}", _log, INTERVAL_S, look)

    def look(self) -> int:
        """Shuts down new connections beyond the cap; how many."""
        inodes, refused = set(), 0
        for name in os.listdir(_OPEN_FILES):
            with contextlib.suppress(OSError):  # closed in the meantime
                file = int(name)
                status = os.fstat(file)
                if not stat.S_ISSOCK(status.st_mode):
                    continue
                inodes.add(status.st_ino)
                if status.st_ino not in self._others and status.st_ino not in self._places:
                    refused += not self._let_in(file, status.st_ino)
        self._others &= inodes
        for inode in self._places.keys() - inodes:
            self._places.pop(inode).close()
        return refused

    def _let_in(self, file: int, inode: int) -> bool:
        with socket.socket(fileno=os.dup(file)) as connection:
            if os.fstat(connection.fileno()).st_ino != inode:
                return True  # another has its number by now, and is seen the next time
            peer = self._peer(connection)
            if peer is None:
                self._others.add(inode)
                return True
            try:
                self._places[inode] = self._connections.enter(peer)
            except TooManyConnections:
                connection.shutdown(socket.SHUT_RDWR)
                return False
        return True

    def _peer(self, connection: socket.socket) -> str | None:
        """The host of the other end of a connection to the port; None for another socket."""
        if connection.family not in (socket.AF_INET, socket.AF_INET6) or connection.getsockname()[1] != self._port:
            return None
        try:
            return str(connection.getpeername()[0])
        except OSError:  # the one that listens
            return None


_BACKLOG = 2048


def listen(host: str, port: int, what: str, field: str) -> socket.socket:
    listener = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
    except OSError as error:
        listener.close()
        raise StartupFailed(
            f"{what} cannot listen on {authority(host, port)}: {_remedy(error, field)}", field=field
        ) from error
    listener.listen(_BACKLOG)
    listener.setblocking(False)
    return listener


def check_port_is_free(host: str, port: int, what: str, field: str) -> None:
    """Raise StartupFailed as `listen` does, for a server that opens its socket itself and says less."""
    if port:
        listen(host, port, what, field).close()


def _remedy(error: OSError, field: str) -> str:
    if error.errno == errno.EADDRINUSE:
        return f"the port is in use; give another one with {_named(field)}"
    reason = (error.strerror or str(error)).lower()
    return f"{reason}; give another address with {_named('host')}, or another port with {_named(field)}"


def _named(field: str) -> str:
    return f"--{field.replace('_', '-')} or {ENVIRONMENT_PREFIX}{field.upper()}"


def authority(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def give_up_on_silent_peers(connection: socket.socket, patience_s: float) -> None:
    """Let the kernel end a connection whose peer takes nothing for so long, also after it was closed here."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)  # to notice one that has vanished
    if sys.platform == "linux":
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(1000 * patience_s))


def raise_open_files_limit(wanted: int) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    possible = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
    if soft != resource.RLIM_INFINITY and soft < possible:
        resource.setrlimit(resource.RLIMIT_NOFILE, (possible, hard))
    if possible < wanted:
        _log.warning(
            f"this process may open {hard} files, {wanted} are needed for all connections that the settings allow: "
            "raise the hard limit (ulimit -n, LimitNOFILE of systemd)"
        )


class Patience:
    """An allowance of seconds: time uses it up, bytes refill it, up to where it began.

    A peer that sends or takes at least `min_bytes_per_s` never runs out of it; one that stops does after `limit_s`.
    """

    def __init__(self, min_bytes_per_s: float, limit_s: float) -> None:
        self._min_bytes_per_s, self._limit_s = min_bytes_per_s, limit_s
        self._left_s = limit_s

    def renew(self) -> None:
        self._left_s = self._limit_s

    def is_over(self, moved_bytes: int, elapsed_s: float) -> bool:
        """Whether the peer has been too slow, `elapsed_s` after the last question, with `moved_bytes` since."""
        gained_s = moved_bytes / self._min_bytes_per_s
        self._left_s = min(self._limit_s, self._left_s + gained_s - elapsed_s)
        return self._left_s <= 0.0
