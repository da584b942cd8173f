"""Brings together what waits and who is idle, and follows each request until it is done or has failed."""

from __future__ import annotations

import asyncio
import logging
import os
import time
from collections import deque
from collections.abc import Awaitable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from ultragray.errors import RenderFailed, UltragrayError
from ultragray.rendering.settings import Encoding, Resolved
from ultragray.rendering.volumes import SliceView
from ultragray.scene.confidence import Extrapolation
from ultragray_workers.errors import Draining
from ultragray_workers.pool.channel import Board, MemoryPool, write_at
from ultragray_workers.pool.messages import (
    Answer,
    AnyTask,
    ForkWorker,
    Hello,
    Loading,
    LoadTask,
    PackTask,
    Place,
    PoolConfig,
    Rendered,
    RenderRequest,
    SceneChangedError,
    Search,
    Task,
    TaskPart,
    UnloadTask,
    reply_bytes,
)
from ultragray_workers.pool.processes import Launcher, Peer, Watch
from ultragray_workers.pool.waiting import Part, Ticket, WaitingQueue
from ultragray_workers.rounds import Rounds

_MAX_DEATHS = 5
_MAX_KILLS = 2
_WATCH_INTERVAL_S = 0.25
_START_ATTEMPTS = 3
_FIRST_RETRY_DELAY_S = 0.05
_LAST_RETRY_DELAY_S = 5.0
STUCK_AFTER_S = 5.0  # without a word from a worker that has work: whoever asks whether the service is ready is told

logger = logging.getLogger(__name__)


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
    start_s: float = field(default_factory=time.monotonic)  # in seconds
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


class Dispatcher:
    """The worker processes and the queue before them, in the event loop's thread."""

    def __init__(self, launcher: Launcher, config: PoolConfig, waiting: WaitingQueue) -> None:
        self.slots: list[Slot] = []
        self._launcher = launcher
        self._config = config
        self._watching: asyncio.TimerHandle | None = None
        self._looks = Rounds("the watch over render processes", logger)
        self._waiting = waiting
        self._memories = MemoryPool()

    async def start(self) -> None:
        """Returns when every process has rendered a frame. Raises BackendUnavailable, RenderFailed.

        The first one tells how many GPUs there are, and leaves compiled kernels where the others find them.
        """
        first = self._add_slot()
        self._watch()
        await first.start()
        processes = self._config.processes or max(1, first.gpus)
        await _all([self._add_slot().start() for _ in range(1, processes)])

    def _add_slot(self) -> Slot:
        slot = Slot(self._launcher, ForkWorker(self._config, len(self.slots)), self)
        self.slots.append(slot)
        return slot

    def submit(self, ticket: Ticket) -> None:
        """Queues a ticket; `ticket.done` tells when its frames lie in its memory. Raises QueueFull."""
        self._waiting.add(ticket)
        self.dispatch()

    def discard(self, ticket: Ticket) -> None:
        """Forgets a ticket, rendered or not: drops what still waits and takes its memory back."""
        self._waiting.remove(ticket)
        ticket.is_discarded = True
        if ticket.in_flight:
            for slot in self.slots:
                slot.give_up_abandoned()
        self._take_back(ticket)

    def _take_back(self, ticket: Ticket) -> None:
        """The memory of a ticket that is discarded, once no worker may write to it any more."""
        if ticket.in_flight or not ticket.is_discarded:
            return
        destination, place = ticket.request.destination, ticket.hand_over()
        if destination is not None and place is not None:
            destination.take_back(place)
        for memory in (ticket.memory, ticket.archive):
            if memory is not None:
                self._memories.release(memory)
        ticket.memory = ticket.archive = None

    async def close(self) -> None:
        """Returns when all worker processes are gone. Fail the tickets first."""
        if self._watching is not None:
            self._watching.cancel()
        await asyncio.gather(*(slot.close() for slot in self.slots))
        self._memories.close()

    def _watch(self) -> None:
        for slot in self.slots:
            with self._looks.round():
                slot.kill_if_hung()
        self._watching = asyncio.get_running_loop().call_later(_WATCH_INTERVAL_S, self._watch)

    async def command_all(self, task: LoadTask | UnloadTask) -> None:
        """Has every process do a task. Raises what the first of them reports, after all have reported."""
        loop = asyncio.get_running_loop()
        commands = [Command(task, loop.create_future()) for _ in self.slots]
        for slot, command in zip(self.slots, commands, strict=True):
            slot.commands.append(command)
        self.dispatch()
        await _all([command.done for command in commands])

    def dispatch(self) -> None:
        """Gives every idle worker something to do: commands first, then what waits."""
        self._waiting.workers = max(1, sum(slot.alive for slot in self.slots))
        for slot in self.slots:
            while slot.idle and slot.commands:
                command = slot.commands.popleft()
                if not command.done.done():
                    slot.assign(command.task, Assignment(command=command))
        idle = [slot for slot in self.slots if slot.idle]
        while idle and (batch := self._waiting.take_batch()):
            scene = batch[0].ticket.request.scene
            slot = next((slot for slot in idle if scene in slot.resident), idle[0])
            idle.remove(slot)
            self._assign(slot, batch)

    def _assign(self, slot: Slot, batch: list[Part]) -> None:
        frames = sum(part.frames for part in batch)
        for part in batch:
            part.ticket.in_flight += 1
            part.ticket.batch_size = max(part.ticket.batch_size, frames)
        assignment = Assignment(steps=dict(enumerate(batch)), batch=tuple(batch))
        first = batch[0]
        if first.packs:
            slot.assign(_pack_task(first.ticket), assignment, [self._memory(first.ticket), self._archive(first.ticket)])
        else:
            memories = [self._memory(part.ticket) for part in batch]  # first: the task tells where in them
            slot.assign(_task(first.ticket, batch), assignment, memories)

    def _memory(self, ticket: Ticket) -> int:
        """The file that the frames of a ticket are written to; with it a ticket counts as begun."""
        if ticket.memory is None:
            ticket.place = _lent(ticket.request)
            ticket.memory = self._memories.acquire() if ticket.place is None else ticket.place.descriptor
            if isinstance(ticket.request.settings, Search):
                os.ftruncate(ticket.memory, 0)
                write_at(ticket.memory, memoryview(ticket.request.settings.data), 0)
        return ticket.memory

    def _archive(self, ticket: Ticket) -> int:
        if ticket.archive is None:
            ticket.archive = self._memories.acquire()
        return ticket.archive

    def on_answer(self, assignment: Assignment, answer: Answer) -> None:
        outcome = answer.outcome
        if (command := assignment.command) is not None:
            if isinstance(outcome, UltragrayError):
                command.fail(outcome)
            elif not command.done.done():
                command.done.set_result(None)
            return
        if answer.last:
            typical = not assignment.loaded and not assignment.given_up
            self._waiting.settle(assignment.batch, time.monotonic() - assignment.start_s, typical=typical)
        step = assignment.steps.pop(answer.part)
        ticket = step.ticket
        ticket.in_flight -= 1
        if ticket.done.done():
            self._take_back(ticket)
            return
        if isinstance(outcome, Rendered):
            self._advance(ticket, step, outcome)
        else:
            self._fail_ticket(ticket, outcome or RenderFailed("a worker answered nothing"))

    def on_death(self, slot: Slot, assignment: Assignment, *, hung: bool) -> None:
        """Has done again what a dead worker had not answered, unless that has taken too many workers with it."""
        if (command := assignment.command) is not None and not command.done.done():
            command.attempts += 1
            command.kills += hung
            if (failure := _failure(command.attempts, command.kills)) is not None:
                command.fail(failure)
            else:
                slot.commands.appendleft(command)
        for step in reversed(assignment.steps.values()):
            step.ticket.in_flight -= 1
            if step.ticket.done.done():
                self._take_back(step.ticket)
                continue
            if (failure := _failure(step.attempts + 1, step.kills + hung)) is not None:
                self._fail_ticket(step.ticket, failure)
                continue
            for again in reversed(step.for_retry(hung=hung)):
                self._waiting.put_first(again)
        self.dispatch()

    def _advance(self, ticket: Ticket, step: Part, outcome: Rendered) -> None:
        """Takes a step of a ticket as done; completes it after its last."""
        if step.packs:
            ticket.done.set_result(_summary([*ticket.rendered, outcome]))
            return
        ticket.rendered.append(outcome)
        ticket.rendered_poses += step.frames
        if ticket.rendered_poses < len(ticket.request.poses):
            return
        if any(rendered.scene_sha256 != outcome.scene_sha256 for rendered in ticket.rendered):
            self._fail_ticket(ticket, SceneChangedError())
        elif _is_archive(ticket):
            self._waiting.put_first(Part(ticket, 0, 0))
            self.dispatch()
        else:
            ticket.done.set_result(_summary(ticket.rendered))

    def _fail_ticket(self, ticket: Ticket, error: Exception) -> None:
        self._waiting.remove(ticket)
        ticket.fail(error)


async def _all(outcomes: Iterable[Awaitable[None]]) -> None:
    for outcome in await asyncio.gather(*outcomes, return_exceptions=True):
        if isinstance(outcome, BaseException):
            raise outcome


def _failure(attempts: int, kills: int) -> RenderFailed | None:
    """The end of what so many workers died with, of which so many hung; None where another one may try."""
    if kills >= _MAX_KILLS:
        return RenderFailed(f"{kills} worker processes hung while they were rendering this, and were killed")
    if attempts >= _MAX_DEATHS:
        return RenderFailed(f"the worker process died {attempts} times while it was rendering this")
    return None


def _summary(steps: list[Rendered]) -> Rendered:
    """The steps of one request as one; the last step knows the size of the reply."""
    if len(steps) == 1:
        return steps[0]
    return Rendered(
        size=steps[-1].size,
        scene_sha256=steps[-1].scene_sha256,
        renderer=steps[-1].renderer,
        started=min(step.started for step in steps),
        render_ms=sum(step.render_ms for step in steps),
        encode_ms=sum(step.encode_ms for step in steps),
        extrapolations=_extrapolations(steps),
        found=steps[-1].found,
    )


def _extrapolations(steps: Iterable[Rendered]) -> tuple[Extrapolation, ...]:
    return tuple(one for step in sorted(steps, key=lambda step: step.first) for one in step.extrapolations)


def _is_archive(ticket: Ticket) -> bool:
    """Whether its frames, once rendered, are not yet the file that was asked for."""
    settings = ticket.request.settings
    return isinstance(settings, Resolved) and settings.encoding is Encoding.NPZ


def _task(ticket: Ticket, parts: list[Part]) -> Task[Any]:
    task_parts: tuple[TaskPart[Any], ...] = tuple(
        TaskPart(
            settings=_without_data(part.ticket.request.settings),
            poses=part.ticket.request.poses[part.first : part.stop],
            first=part.first,
            total=len(part.ticket.request.poses),
            deadline=part.ticket.request.deadline,
            **_where(part.ticket.place),
        )
        for part in parts
    )
    return Task(scene=ticket.request.scene, path=ticket.path, version=ticket.request.version, parts=task_parts)


def _where(place: Place | None) -> dict[str, int]:
    return {} if place is None else {"offset": place.offset, "room": place.size}


def _lent(request: RenderRequest[Any]) -> Place | None:
    """A place for frames in the caller's own memory; None where they come through that of the pool."""
    settings = request.settings
    if request.destination is None or not isinstance(settings, Resolved) or settings.encoding is Encoding.NPZ:
        return None
    return request.destination.lend(reply_bytes(settings, len(request.poses)))


def _without_data(settings: Resolved | SliceView | Search) -> Resolved | SliceView | Search:
    """Settings as a message takes them: the data of a search lie in the memory."""
    return replace(settings, data=b"") if isinstance(settings, Search) else settings


def _pack_task(ticket: Ticket) -> PackTask:
    return PackTask(
        scene=ticket.request.scene,
        scene_sha256=ticket.rendered[0].scene_sha256,
        renderer=ticket.rendered[0].renderer,
        settings=ticket.request.settings,
        poses=ticket.request.poses,
        extrapolations=_extrapolations(ticket.rendered),
    )
