"""Child processes as the service sees them: started as forks of a template that has torch imported, watched, replaced
when they die or hang.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

from ultragray.errors import RenderFailed, UltragrayError
from ultragray_workers.errors import Draining
from ultragray_workers.pool.channel import Board, Channel
from ultragray_workers.pool.messages import (
    Answer,
    AnyTask,
    ForkTemplate,
    ForkWorker,
    Hello,
    Loading,
    LoadTask,
    PoolConfig,
    UnloadTask,
)
from ultragray_workers.pool.waiting import Part

if TYPE_CHECKING:
    from ultragray_workers.pool.dispatcher import Dispatcher

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


STUCK_AFTER_S = 5.0  # without a word from a worker that has work: whoever asks whether the service is ready is told


class Watch:
    """What is expected of a worker, in time.monotonic() seconds. It costs a task no timer: whoever watches asks."""

    def __init__(self, config: PoolConfig) -> None:
        self._grace_s, self._timeout_s = config.worker_grace_s, config.worker_timeout_s
        self._begun = self._heard = 0.0
        self._deadline: float | None = None
        self._loading = False

    def begin(self, deadline: float | None) -> None:
        """The worker is given a task whose frames somebody waits for until then; None: for as long as it takes."""
        self._begun = self._heard = time.monotonic()
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
            late_s = now - self._begun - self._grace_s
            return f"it did not take up its task within {self._grace_s:g} s" if late_s > 0 else None
        if self._loading or self._deadline is None:
            late_s = now - self._heard - self._timeout_s
            return f"it told nothing for {self._timeout_s:g} s" if late_s > 0 else None
        late_s = now - max(self._deadline, self._heard) - self._grace_s
        return f"it owed an answer for {self._grace_s:g} s after the deadline" if late_s > 0 else None


# One place in the pool: a worker process, what it is doing, and its replacement when it dies or hangs.


logger = logging.getLogger(__name__)

_START_ATTEMPTS = 3
_FIRST_RETRY_DELAY_S = 0.05
_LAST_RETRY_DELAY_S = 5.0


@dataclass(eq=False)
class Command:
    """Something one certain slot is to do, whichever process fills it by then."""

    task: LoadTask | UnloadTask
    done: asyncio.Future[None]
    attempts: int = 0  # workers that died with it
    kills: int = 0  # of those, the ones that hung and were killed

    def fail(self, error: UltragrayError) -> None:
        if not self.done.done():
            self.done.set_exception(error)


@dataclass(eq=False)
class Assignment:
    """The steps of a batch that a worker has not answered yet, or its command."""

    steps: dict[int, Part] = field(default_factory=dict)
    command: Command | None = None
    batch: tuple[Part, ...] = ()  # all of its steps
    begun: float = field(default_factory=time.monotonic)  # in seconds
    loaded: bool = False  # a scene, which took longer than frames do
    given_up: bool = False

    @property
    def abandoned(self) -> bool:
        """Whether nobody waits for anything of it any more."""
        return self.command is None and all(step.ticket.done.done() for step in self.steps.values())

    @property
    def deadline(self) -> float | None:
        """The latest of its steps', in time.monotonic() seconds; None where one has none."""
        deadlines = [step.ticket.request.deadline for step in self.steps.values()]
        return max((d for d in deadlines if d is not None), default=None) if None not in deadlines else None


class Slot:
    """A worker process and what it is doing; started again whenever it dies, killed when it hangs."""

    def __init__(self, launcher: Launcher, settings: ForkWorker, dispatcher: Dispatcher) -> None:
        self.resident: tuple[str, ...] = ()  # scenes its worker holds
        self.commands: deque[Command] = deque()
        self.replacements = 0  # of workers that died
        self.kills = 0  # of workers that hung
        self.gpus = 0  # that its worker found
        self._launcher = launcher
        self._settings = settings
        self._dispatcher = dispatcher
        self._peer: Peer | None = None
        self.alive = False  # whether its worker has said Hello and works
        self._assignment: Assignment | None = None
        self._board: Board  # of the process at work here
        self._tasks = 0  # given to it
        self._watch = Watch(settings.pool)
        self._hung = False  # it is being killed
        self._settled = asyncio.Event()  # it has once been ready, or could not be started
        self._failed_starts = 0
        self._start_error: UltragrayError | None = None
        self._retry: asyncio.TimerHandle | None = None
        self._closing = False

    @property
    def pid(self) -> int | None:
        """The process at work here; None while there is none."""
        return self._peer.pid if self.alive and self._peer is not None else None

    @property
    def idle(self) -> bool:
        return self.alive and self._assignment is None

    @property
    def busy(self) -> bool:
        return self._assignment is not None

    @property
    def stuck(self) -> bool:
        """Whether its worker has told nothing of its task for a while."""
        return self._assignment is not None and self._watch.quiet_s > STUCK_AFTER_S

    async def start(self) -> None:
        self._launch()
        await self._settled.wait()
        if self._start_error is not None:
            raise self._start_error

    def _launch(self) -> None:
        self._retry = None
        self._start_error = None
        memory = Board.new_memory()
        self._board, self._tasks = Board(memory), 0
        self._peer = self._launcher.launch(self._settings, self._on_message, self._on_gone, [memory])
        os.close(memory)

    def assign(self, task: AnyTask, assignment: Assignment, descriptors: Sequence[int] = ()) -> None:
        assert self._peer is not None
        self._assignment = assignment
        self._tasks += 1
        self._watch.begin(assignment.deadline)
        self._peer.send(task, descriptors)

    def give_up_abandoned(self) -> None:
        """Ends the rendering that nobody waits for any more."""
        if self._assignment is not None and self._assignment.abandoned:
            self._board.given_up[0] = self._tasks
            self._assignment.given_up = True

    def kill_if_hung(self) -> None:
        """Kills the worker where it owes an answer for too long; another one takes its place."""
        if self._assignment is None or self._hung or self._peer is None:
            return
        complaint = self._watch.complaint(taken=self._board.taken[0] >= self._tasks)
        if complaint is not None:
            logger.error("a render worker hangs (process %s): %s; killing it", self._peer.pid, complaint)
            self._hung = True
            self._peer.kill()

    async def close(self) -> None:
        """Returns when the process is gone; the commands it had not answered fail."""
        self._closing = True
        if self._retry is not None:
            self._retry.cancel()
        if self._peer is not None:
            await self._peer.stop()
        stopping = Draining("the service is stopping")
        if not self._settled.is_set():
            self._start_error = stopping
            self._settled.set()
        while self.commands:
            self.commands.popleft().fail(stopping)

    def _on_message(self, message: Hello | Loading | Answer) -> None:
        assert self._peer is not None
        if isinstance(message, Hello):
            self._peer.pid = message.pid
            if message.error is not None:
                self._start_error = message.error  # the process exits now
                return
            self.gpus = message.gpus
            self.alive = True
            self._failed_starts = 0
            self._settled.set()
            self._dispatcher.dispatch()
            return
        if isinstance(message, Loading):
            self._watch.hear(message.begins)
            if self._assignment is not None:
                self._assignment.loaded = True
            return
        self._watch.hear()
        self.resident = message.resident
        assignment = self._assignment
        assert assignment is not None
        if message.last:
            self._assignment = None
        self._dispatcher.on_answer(assignment, message)
        if message.last:
            self._dispatcher.dispatch()

    def _on_gone(self) -> None:
        worked, self.alive = self.alive, False
        self._board.close()
        hung, self._hung = self._hung, False
        assignment, self._assignment = self._assignment, None
        self.resident = ()
        if worked and not self._closing:
            if hung:
                self.kills += 1
            else:
                logger.warning("a render worker died (process %s); replacing it", self._peer and self._peer.pid)
                self.replacements += 1
            self._launch()
        elif not self._closing:
            self._start_again_later()
        if assignment is not None:
            self._dispatcher.on_death(self, assignment, hung=hung)

    def _start_again_later(self) -> None:
        self._failed_starts += 1
        known = self._start_error is not None
        if self._start_error is None:
            self._start_error = RenderFailed(
                "a worker process ended before it was ready; its reason is on the service's standard error"
            )
        if not self._settled.is_set() and (known or self._failed_starts >= _START_ATTEMPTS):
            self._settled.set()
            return
        delay_s = min(_LAST_RETRY_DELAY_S, _FIRST_RETRY_DELAY_S * 2.0 ** (self._failed_starts - 1))
        logger.warning("a render worker could not start: %s; trying again in %.2f s", self._start_error, delay_s)
        self._retry = asyncio.get_running_loop().call_later(delay_s, self._launch)
