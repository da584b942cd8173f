"""One place in the pool: a worker process, what it is doing, and its replacement when it dies or hangs."""

from __future__ import annotations

import asyncio
import logging
import os
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from ultragray.errors import RenderFailed, UltragrayError
from ultragray_workers.errors import Draining
from ultragray_workers.pool.board import Board
from ultragray_workers.pool.launcher import Launcher
from ultragray_workers.pool.messages import Answer, ForkWorker, Hello, Loading, LoadTask, Task, UnloadTask
from ultragray_workers.pool.peer import Peer
from ultragray_workers.pool.waiting import Step
from ultragray_workers.pool.watchdog import STUCK_AFTER_S, Patience, Watch

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

    steps: dict[int, Step] = field(default_factory=dict)
    command: Command | None = None
    batch: tuple[Step, ...] = ()  # all of its steps
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


class SlotListener(Protocol):
    """The pool, as its slots see it."""

    def on_answer(self, assignment: Assignment, answer: Answer) -> None: ...

    def on_death(self, slot: Slot, assignment: Assignment, *, hung: bool) -> None: ...

    def on_idle(self) -> None: ...


class Slot:
    """A worker process and what it is doing; started again whenever it dies, killed when it hangs."""

    def __init__(self, launcher: Launcher, settings: ForkWorker, patience: Patience, listener: SlotListener) -> None:
        self.resident: tuple[str, ...] = ()  # scenes its worker holds
        self.commands: deque[Command] = deque()
        self.replacements = 0  # of workers that died
        self.kills = 0  # of workers that hung
        self.gpus = 0  # that its worker found
        self._launcher = launcher
        self._settings = settings
        self._listener = listener
        self._peer: Peer | None = None
        self.alive = False  # whether its worker has said Hello and works
        self._assignment: Assignment | None = None
        self._board: Board  # of the process at work here
        self._tasks = 0  # given to it
        self._watch = Watch(patience)
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
        """Returns when the first worker is ready. Raises what keeps it from starting."""
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

    def assign(self, task: Task, assignment: Assignment, descriptors: Sequence[int] = ()) -> None:
        """Gives the idle worker a task."""
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
            self._listener.on_idle()
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
        self._listener.on_answer(assignment, message)
        if message.last:
            self._listener.on_idle()

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
            self._listener.on_death(self, assignment, hung=hung)

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
