"""A child process as the service sees it: a channel that the event loop reads, and its end."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import time
from collections.abc import Callable, Sequence
from typing import Any

from ultragray_workers.pool.channel import Channel

_STOP_TIMEOUT_S = 2.0
_POLL_INTERVAL_S = 0.002


class Peer:
    """Calls `on_message` for each message and `on_gone` once when the process has ended, however it ended.

    A process that hangs up on its own is told so by the end of file; nothing is polled.
    """

    def __init__(self, channel: Channel, on_message: Callable[[Any], None], on_gone: Callable[[], None]) -> None:
        self.pid: int | None = None  # set by whoever reads the child's Hello
        self._channel = channel
        self._on_message = on_message
        self._on_gone = on_gone
        self._loop = asyncio.get_running_loop()
        self._ended = asyncio.Event()
        channel.set_blocking(False)
        self._loop.add_reader(channel.fileno(), self._read)

    @property
    def alive(self) -> bool:
        return not self._ended.is_set()

    def send(self, message: object, descriptors: Sequence[int] = ()) -> None:
        """Sends a message; to a process that has just died it is lost, and `on_gone` follows."""
        with contextlib.suppress(OSError):
            self._channel.send(message, descriptors)

    def kill(self) -> None:
        """Ends the process, even a stopped one; `on_gone` follows, also where the kernel does not let go of it."""
        if self.pid is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)
        self._loop.call_later(_STOP_TIMEOUT_S, self._end)

    async def stop(self) -> None:
        """Has the process exit, kills it where it does not, and returns when it is gone."""
        if self.alive:
            self._channel.hang_up()
            try:
                await asyncio.wait_for(self._ended.wait(), _STOP_TIMEOUT_S)
            except asyncio.TimeoutError:
                if self.pid is None:
                    self._end()
                else:
                    os.kill(self.pid, signal.SIGKILL)
                    await self._ended.wait()
        give_up = time.monotonic() + _STOP_TIMEOUT_S
        while self.pid is not None and _exists(self.pid) and time.monotonic() < give_up:
            await asyncio.sleep(_POLL_INTERVAL_S)  # its files close a little before its entry goes

    def _read(self) -> None:
        try:
            message, _ = self._channel.receive()
        except BlockingIOError:
            return
        except (EOFError, OSError):
            self._end()
            return
        self._on_message(message)

    def _end(self) -> None:
        if not self.alive:
            return
        self._loop.remove_reader(self._channel.fileno())
        self._channel.close()
        self._ended.set()
        self._on_gone()


def _exists(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True
