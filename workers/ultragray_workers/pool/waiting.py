"""The queue of requests that wait: their order, and batches of those that can be rendered together."""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict, deque
from dataclasses import dataclass, field, replace
from typing import Any

from ultragray.probe import FloatArray
from ultragray.settings import Encoding

from ..errors import DeadlineExceeded, QueueFull
from .messages import Rendered
from .types import Priority, RenderRequest

_FULL_BATCH_PIXELS_PER_POSE = 512 * 512
_ATTEMPTS_IN_COMPANY = 2
_BATCH_PRIORITY_SHARE = 4  # an interactive request may have to wait for a part of a batch: a smaller one
_BATCH_PATIENCE_S = 1.0


@dataclass(eq=False)
class Ticket:
    """A request that waits or is rendered, and how far it has come."""

    request: RenderRequest
    path: str  # of the scene's file
    done: asyncio.Future[Rendered]
    submitted: float  # time.monotonic() in seconds
    waiting: deque[Step] = field(default_factory=deque)
    in_flight: int = 0  # parts that workers have
    rendered: list[Rendered] = field(default_factory=list)
    rendered_poses: int = 0
    batch_size: int = 0
    memory: int | None = None  # descriptor of the file that its frames are written to, once it is begun
    archive: int | None = None  # and of the .npz, where that is made of several parts

    @property
    def batch_key(self) -> tuple[Any, ...]:
        """Requests that agree in this can be rendered together."""
        return (self.request.scene, *self.request.settings.view)

    @property
    def expired(self) -> bool:
        return self.request.deadline is not None and time.monotonic() >= self.request.deadline

    @property
    def untouched(self) -> bool:
        """Whether all of it still waits to be rendered."""
        return bool(self.waiting) and self.memory is None and not self.done.done()

    @property
    def needs_packing(self) -> bool:
        """Whether its rendered frames are not yet the file that was asked for."""
        return self.request.settings.encoding is Encoding.NPZ and len(self.rendered) > 1

    @property
    def reply_memory(self) -> int:
        """The file that holds the reply, once it is done."""
        memory = self.memory if self.archive is None else self.archive
        assert memory is not None
        return memory

    def fail(self, error: Exception) -> None:
        if not self.done.done():
            self.done.set_exception(error)


@dataclass(eq=False)
class Turn:
    """One caller's place in the queue, which a newer pose may take while it waits."""

    ticket: Ticket | None = None  # None until the request is queued
    expiry: Expiry | None = None

    def give_to(self, poses: FloatArray, deadline: float | None) -> bool:
        """Has other poses rendered in place of those that wait, as many of them; False where that is too late."""
        ticket = self.ticket
        if ticket is None or not ticket.untouched:
            return False
        assert len(poses) == len(ticket.request.poses)
        ticket.request = replace(ticket.request, poses=poses, deadline=deadline)
        ticket.submitted = time.monotonic()
        if self.expiry is not None:
            self.expiry.watch()
        return True


@dataclass(eq=False)
class Part:
    """Poses `first` to `stop` of a ticket, rendered in one go."""

    ticket: Ticket
    first: int
    stop: int
    attempts: int = 0  # workers that died with it

    @property
    def frames(self) -> int:
        return self.stop - self.first

    def for_retry(self) -> list[Step]:
        """Itself in halves, so that even slow frames get done between one death and the next."""
        middle = (self.first + self.stop + 1) // 2
        bounds = [(self.first, middle), (middle, self.stop)]
        return [Part(self.ticket, first, stop, self.attempts + 1) for first, stop in bounds if first < stop]


@dataclass(eq=False)
class Packing:
    """The last step of an .npz whose frames were rendered in several parts."""

    ticket: Ticket
    attempts: int = 0
    frames: int = 0

    def for_retry(self) -> list[Step]:
        return [Packing(self.ticket, self.attempts + 1)]


Step = Part | Packing


class WaitingQueue:
    """Tickets with steps that wait: by priority, then in turn, one part of a ticket at a time.

    Batches wait for as long as interactive requests do, but get one part rendered per second at the least.

    The limit holds for each priority on its own, so that a flood of batch frames leaves room for others.
    """

    def __init__(self, limit_frames: int, max_batch_poses: int) -> None:
        self._limit_frames = limit_frames
        self._max_batch_poses = max_batch_poses
        self._tickets: dict[Priority, OrderedDict[Ticket, None]] = {priority: OrderedDict() for priority in Priority}
        self._frames = dict.fromkeys(Priority, 0)
        self._last_batch_turn = time.monotonic()  # or since when a batch waits

    @property
    def frames(self) -> int:
        """Poses that wait."""
        return sum(self._frames.values())

    def add(self, ticket: Ticket) -> None:
        """Raises QueueFull; a request larger than the limit is taken only while nothing else waits."""
        count, waiting = len(ticket.request.poses), self._frames[ticket.request.priority]
        if waiting and waiting + count > self._limit_frames:
            raise QueueFull(
                f"{waiting} frames wait already and {count} more would exceed the limit of "
                f"{self._limit_frames}; try again shortly"
            )
        if not self._tickets[Priority.BATCH] and ticket.request.priority is Priority.BATCH:
            self._last_batch_turn = time.monotonic()
        size = self._poses_together(ticket)
        for first in range(0, count, size):
            self._append(Part(ticket, first, min(first + size, count)))

    def put_first(self, step: Step) -> None:
        """Puts a step that was begun and lost ahead of all that waits."""
        ticket = step.ticket
        ticket.waiting.appendleft(step)
        self._frames[ticket.request.priority] += step.frames
        tickets = self._tickets[ticket.request.priority]
        tickets[ticket] = None
        tickets.move_to_end(ticket, last=False)

    def remove(self, ticket: Ticket) -> None:
        """Drops all of a ticket that waits."""
        priority = ticket.request.priority
        self._frames[priority] -= sum(step.frames for step in ticket.waiting)
        ticket.waiting.clear()
        self._tickets[priority].pop(ticket, None)

    def take_batch(self) -> list[Step]:
        """The steps to be done next, together; empty when nothing waits. Drops tickets past their deadline."""
        priorities = list(Priority)
        if time.monotonic() - self._last_batch_turn >= _BATCH_PATIENCE_S:
            priorities.reverse()
        for priority in priorities:
            tickets = self._tickets[priority]
            while tickets:
                ticket = next(iter(tickets))
                if ticket.expired:
                    self.expire(ticket)
                    continue
                step = self._take(ticket)
                return [step, *self._take_company(step)] if isinstance(step, Part) else [step]
        return []

    def expire(self, ticket: Ticket) -> None:
        """Drops a ticket that is past its deadline, if any of it still waits."""
        if ticket.waiting and ticket.expired:
            self.remove(ticket)
            waited_ms = (time.monotonic() - ticket.submitted) * 1000.0
            ticket.fail(DeadlineExceeded(f"the deadline passed before the frames were rendered ({waited_ms:.0f} ms)"))

    def _take_company(self, first: Part) -> list[Part]:
        if first.attempts >= _ATTEMPTS_IN_COMPANY:
            return []  # it may be what kills the workers
        room = self._poses_together(first.ticket) - first.frames
        company: list[Part] = []
        for ticket in list(self._tickets[first.ticket.request.priority]):
            if room <= 0:
                break
            if ticket.batch_key != first.ticket.batch_key or ticket.expired:
                continue
            while ticket.waiting:
                step = ticket.waiting[0]
                if not isinstance(step, Part) or step.frames > room or step.attempts >= _ATTEMPTS_IN_COMPANY:
                    break
                self._take(ticket)
                company.append(step)
                room -= step.frames
        return company

    def _append(self, part: Part) -> None:
        priority = part.ticket.request.priority
        part.ticket.waiting.append(part)
        self._frames[priority] += part.frames
        self._tickets[priority].setdefault(part.ticket)

    def _take(self, ticket: Ticket) -> Step:
        priority = ticket.request.priority
        if priority is Priority.BATCH:
            self._last_batch_turn = time.monotonic()
        step = ticket.waiting.popleft()
        self._frames[priority] -= step.frames
        if ticket.waiting:
            self._tickets[priority].move_to_end(ticket)  # others get their turn before its next part
        else:
            del self._tickets[priority][ticket]
        return step

    def _poses_together(self, ticket: Ticket) -> int:
        """The number of poses in a full batch: fewer for images of more than 512x512 pixels."""
        share = _BATCH_PRIORITY_SHARE if ticket.request.priority is Priority.BATCH else 1
        settings = ticket.request.settings
        pixels = settings.height * settings.width * len(settings.outputs)
        fitting = self._max_batch_poses * _FULL_BATCH_PIXELS_PER_POSE // pixels
        return max(1, min(self._max_batch_poses, fitting) // share)


class Expiry:
    """Drops a ticket in time, should it still wait at its deadline."""

    def __init__(self, ticket: Ticket, queue: WaitingQueue) -> None:
        self._ticket, self._queue = ticket, queue
        self._timer: asyncio.TimerHandle | None = None
        self.watch()

    def watch(self) -> None:
        """Looks at the deadline, which may have changed."""
        self.cancel()
        deadline = self._ticket.request.deadline
        if deadline is not None:
            delay_s = max(0.0, deadline - time.monotonic())
            self._timer = asyncio.get_running_loop().call_later(delay_s, self._look)

    def _look(self) -> None:
        if self._ticket.expired:
            self._queue.expire(self._ticket)
        else:  # the timer was a little early
            self.watch()

    def cancel(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
