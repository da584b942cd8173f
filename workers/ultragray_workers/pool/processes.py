"""Child processes as the service sees them: started as forks of a template that has torch imported, watched, replaced
when they die or hang.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from ultragray_workers.pool.channel import Channel
from ultragray_workers.pool.messages import (
    ForkTemplate,
    ForkWorker,
    Hello,
    PoolConfig,
)

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


# Starts worker processes within milliseconds: forks of template processes that have torch imported.
#
# There are two templates, so that a worker can be replaced at once even when a template was killed a moment before:
# the survivor forks both the worker and the next template.


_TEMPLATES = 2


def start_template(descriptor: int) -> subprocess.Popen[bytes]:
    program = (
        f"import sys; sys.path[:] = {sys.path!r}; from ultragray_workers.pool.template import main; main({descriptor})"
    )
    return subprocess.Popen(
        [sys.executable, "-c", program],
        stdin=subprocess.DEVNULL,
        pass_fds=[descriptor],
        # numpy's OpenBLAS starts its threads on import, and a process with threads must not be forked
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )


class Launcher:
    """Owns the template processes. Its methods belong to the event loop's thread."""

    def __init__(self) -> None:
        self._templates: list[_Template] = []  # oldest first
        self._reaping: set[asyncio.Future[int]] = set()
        self._closing = False

    def launch(
        self,
        request: ForkWorker | ForkTemplate,
        on_message: Callable[[Any], None],
        on_gone: Callable[[], None],
        descriptors: Sequence[int] = (),
    ) -> Peer:
        """Has a template fork a process, which gets the descriptors; the first message of the new peer is its Hello.

        Returns at once. Where no template is ready yet the request waits for one; where that dies before it
        forked, the new peer is gone.
        """
        template = next((t for t in self._templates if t.ready), None)
        if template is None:
            template = self._templates[0] if self._templates else self._spawn_template()
        near, far = Channel.pair()
        template.peer.send(request, [far.fileno(), *descriptors])
        far.close()
        return Peer(near, on_message, on_gone)

    def abandon_starting(self) -> None:
        """Kills templates that are still importing, and with them what waits to be forked."""
        self._closing = True
        for template in self._templates:
            if not template.ready and template.process is not None:
                template.process.kill()

    async def close(self) -> None:
        """Returns when all templates are gone. Stop the workers first: they are the templates' children."""
        self._closing = True
        for template in reversed(self._templates.copy()):  # children before parents
            await template.peer.stop()
        await asyncio.gather(*self._reaping)

    def _spawn_template(self) -> _Template:
        near, far = Channel.pair()
        process = start_template(far.fileno())
        far.close()
        template = _Template(process)
        template.peer = Peer(near, partial(self._on_hello, template), partial(self._on_gone, template))
        self._templates.append(template)
        return template

    def _fork_template(self) -> None:
        template = _Template(None)
        template.peer = self.launch(ForkTemplate(), partial(self._on_hello, template), partial(self._on_gone, template))
        self._templates.append(template)

    def _on_hello(self, template: _Template, hello: Hello) -> None:
        template.ready = True
        template.peer.pid = hello.pid
        self._top_up()

    def _on_gone(self, template: _Template) -> None:
        self._templates.remove(template)
        if template.process is not None:
            reaping = asyncio.get_running_loop().run_in_executor(None, template.process.wait)
            self._reaping.add(reaping)
            reaping.add_done_callback(self._reaping.discard)
        if template.ready:  # one that cannot even start is tried again only when a worker is wanted
            self._top_up()

    def _top_up(self) -> None:
        if self._closing:
            return
        if not self._templates:
            self._spawn_template()
        elif len(self._templates) < _TEMPLATES and self._templates[0].ready:
            self._fork_template()


class _Template:
    peer: Peer

    def __init__(self, process: subprocess.Popen[bytes] | None) -> None:
        self.process = process  # None: forked from another template, which reaps it
        self.ready = False


# How long a worker may owe an answer, and how it is noticed that one hangs.


class Watch:
    """What is expected of a worker, in time.monotonic() seconds. It costs a task no timer: whoever watches asks."""

    def __init__(self, config: PoolConfig) -> None:
        self._grace_s, self._timeout_s = config.worker_grace_s, config.worker_timeout_s
        self._start_s = self._heard = 0.0
        self._deadline: float | None = None
        self._loading = False

    def begin(self, deadline: float | None) -> None:
        """The worker is given a task whose frames somebody waits for until then; None: for as long as it takes."""
        self._start_s = self._heard = time.monotonic()
        self._deadline = deadline
        self._loading = False

    def hear(self, loading: bool | None = None) -> None:
        """The worker has told something; `loading`: that it begins to load a scene, or has done so."""
        self._heard = time.monotonic()
        if loading is not None:
            self._loading = loading

    @property
    def quiet_s(self) -> float:
        return time.monotonic() - self._heard

    def complaint(self, taken: bool) -> str | None:
        """The reason to give up on the worker; None while there is none. `taken`: whether it has taken up its task."""
        now = time.monotonic()
        if not taken:
            late_s = now - self._start_s - self._grace_s
            return f"it did not take up its task within {self._grace_s:g} s" if late_s > 0 else None
        if self._loading or self._deadline is None:
            late_s = now - self._heard - self._timeout_s
            return f"it told nothing for {self._timeout_s:g} s" if late_s > 0 else None
        late_s = now - max(self._deadline, self._heard) - self._grace_s
        return f"it owed an answer for {self._grace_s:g} s after the deadline" if late_s > 0 else None
