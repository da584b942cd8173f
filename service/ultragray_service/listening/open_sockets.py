"""A cap by address on connections that a library accepts by itself, as gRPC does.

This process finds its own sockets among its open files, and shuts down those of an address that has too many: the
library sees them end as if the peer had hung up. Connections that are known stay; new ones go.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import socket
import stat

from ultragray_service.errors import TooManyConnections
from ultragray_service.listening.connections import Connections, Place
from ultragray_workers.rounds import Rounds

INTERVAL_S = 0.25
_OPEN_FILES = "/dev/fd"

_log = logging.getLogger("ultragray.service")


class OpenSockets:
    """The connections to one port of this process."""

    def __init__(self, port: int, connections: Connections) -> None:
        self._port = port
        self._connections = connections
        self._others: set[int] = set()  # sockets that are no connections to the port, by inode
        self._places: dict[int, Place] = {}  # the connections, by inode

    async def run(self) -> None:
        """Look again and again, until cancelled."""
        rounds = Rounds(f"the watch over connections to port {self._port}", _log)
        while True:
            with rounds.round():
                if refused := await asyncio.to_thread(self.look):
                    _log.warning(f"closed {refused} connections to port {self._port}: too many of one address")
            await asyncio.sleep(INTERVAL_S)

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
            self._places.pop(inode).leave()
        return refused

    def _let_in(self, file: int, inode: int) -> bool:
        """Notes a socket that is new. Raises OSError where it has gone."""
        with socket.socket(fileno=os.dup(file)) as found:
            if os.fstat(found.fileno()).st_ino != inode:
                return True  # another has its number by now, and is seen the next time
            peer = self._peer(found)
            if peer is None:
                self._others.add(inode)
                return True
            try:
                self._places[inode] = self._connections.enter(peer)
            except TooManyConnections:
                found.shutdown(socket.SHUT_RDWR)
                return False
        return True

    def _peer(self, found: socket.socket) -> str | None:
        """The host of the other end of a connection to the port; None for another socket."""
        if found.family not in (socket.AF_INET, socket.AF_INET6) or found.getsockname()[1] != self._port:
            return None
        try:
            return str(found.getpeername()[0])
        except OSError:  # the one that listens
            return None
