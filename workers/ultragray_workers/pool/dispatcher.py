"""Brings together what waits and who is idle, and follows each request until it is done or has failed."""

from __future__ import annotations

import asyncio
import logging
import os
import time
from collections.abc import Awaitable, Iterable
from dataclasses import replace
from typing import Any

from ultragray.errors import RenderFailed, UltragrayError
from ultragray.rendering.settings import Encoding, Resolved
from ultragray.rendering.volumes import SliceView
from ultragray.scene.confidence import Extrapolation
from ultragray_workers.pool.channel import MemoryPool, write_at
from ultragray_workers.pool.messages import (
    Answer,
    ForkWorker,
    LoadTask,
    PackTask,
    PoolConfig,
    Rendered,
    SceneChangedError,
    Sought,
    Task,
    TaskPart,
    UnloadTask,
)
from ultragray_workers.pool.processes import Assignment, Command, Launcher, Slot
from ultragray_workers.pool.waiting import Part, Ticket, WaitingQueue
from ultragray_workers.rounds import Rounds

_MAX_DEATHS = 5
_MAX_KILLS = 2
_WATCH_INTERVAL_S = 0.25

logger = logging.getLogger(__name__)


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
        if ticket.in_flight:
            for slot in self.slots:
                slot.give_up_abandoned()
        for memory in (ticket.memory, ticket.archive):
            if memory is None:
                continue
            if ticket.in_flight:  # a worker may still write to it
                os.close(memory)
            else:
                self._memories.release(memory)

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
            slot.assign(_task(first.ticket, batch), assignment, [self._memory(part.ticket) for part in batch])

    def _memory(self, ticket: Ticket) -> int:
        """The file that the frames of a ticket are written to; with it a ticket counts as begun."""
        if ticket.memory is None:
            ticket.memory = self._memories.acquire()
            if isinstance(ticket.request.settings, Sought):
                os.ftruncate(ticket.memory, 0)
                write_at(ticket.memory, memoryview(ticket.request.settings.image), 0)
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
            self._waiting.settle(assignment.batch, time.monotonic() - assignment.begun, typical=typical)
        step = assignment.steps.pop(answer.part)
        ticket = step.ticket
        ticket.in_flight -= 1
        if ticket.done.done():
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
        if len({rendered.scene_sha256 for rendered in ticket.rendered}) > 1:
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
    found: tuple[TaskPart[Any], ...] = tuple(
        TaskPart(
            settings=_sent(part.ticket.request.settings),
            poses=part.ticket.request.poses[part.first : part.stop],
            first=part.first,
            total=len(part.ticket.request.poses),
            deadline=part.ticket.request.deadline,
        )
        for part in parts
    )
    return Task(scene=ticket.request.scene, path=ticket.path, version=ticket.request.version, parts=found)


def _sent(settings: Resolved | SliceView | Sought) -> Resolved | SliceView | Sought:
    """Settings as a message takes them: what is sought lies in the memory."""
    return replace(settings, image=b"") if isinstance(settings, Sought) else settings


def _pack_task(ticket: Ticket) -> PackTask:
    return PackTask(
        scene=ticket.request.scene,
        scene_sha256=ticket.rendered[0].scene_sha256,
        renderer=ticket.rendered[0].renderer,
        settings=ticket.request.settings,
        poses=ticket.request.poses,
        extrapolations=_extrapolations(ticket.rendered),
    )
