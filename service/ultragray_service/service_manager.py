"""The words that systemd understands: the process is ready, still alive, stopping. Without systemd they go nowhere.

A unit of `Type=notify` names a socket in NOTIFY_SOCKET; one with `WatchdogSec` expects a word within that time, and
restarts a process from which it hears none.
"""

from __future__ import annotations

import asyncio
import os
import socket
from contextlib import suppress

READY, ALIVE, STOPPING = "READY=1", "WATCHDOG=1", "STOPPING=1"
_WORDS_WITHIN_TIMEOUT = 3


class ServiceManager:
    """The service manager that started this process, if one did."""

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
        """Tells for as long as the event loop turns that it does."""
        while self.alive_every_s is not None:
            self.tell(ALIVE)
            await asyncio.sleep(self.alive_every_s)
