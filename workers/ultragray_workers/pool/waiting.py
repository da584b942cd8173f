"""The queue of requests that wait: their order, and batches of those that can be rendered together."""

from __future__ import annotations

import asyncio
import math
import time
from collections import OrderedDict, deque
from collections.abc import Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

from ultragray.rendering.settings import Resolved
from ultragray.rendering.volumes import SliceView
from ultragray_workers.errors import DeadlineExceeded, QueueFull
from ultragray_workers.pool.messages import Place, Priority, Rendered, RenderRequest, Search
from ultragray_workers.pool.turns import Forecast, Turns

_FULL_BATCH_PIXELS_PER_POSE = 512 * 512
_PRIORITIES = tuple(Priority)
_ATTEMPTS_IN_COMPANY = 2
_BATCH_PRIORITY_SHARE = 4  # an interactive request may have to wait for a part of a batch: a smaller one
_BATCH_PATIENCE_S = 1.0
_LONGEST_BATCH_S = {Priority.INTERACTIVE: 0.02, Priority.BATCH: 0.05}  # that others may have to wait for, where known
_LEAST_RETRY_S = 0.1


@lru_cache(maxsize=4096)
def _kind(*_: Hashable) -> Hashable:
    """One object for what is equal: hashing all of the settings takes its time."""
    return object()


@dataclass(eq=False)
class Ticket:
    """A request that waits or is rendered, and how far it has come."""

    request: RenderRequest[Any]
    path: str  # of the scene's file
    done: asyncio.Future[Rendered]
    submitted: float  # time.monotonic() in seconds
    waiting: deque[Part] = field(default_factory=deque)
    in_flight: int = 0  # parts that workers have
    rendered: list[Rendered] = field(default_factory=list)
    rendered_poses: int = 0
    batch_size: int = 0
    memory: int | None = None  # descriptor of the file that its frames are written to, once it is begun
    place: Place | None = None  # in that file, where it is the caller's
    archive: int | None = None  # and of the .npz that is made of them, where that is asked for
    is_discarded: bool = False  # nobody waits for it any more

    @cached_property
    def kind(self) -> Hashable:
        """Requests of one kind can be rendered together, and take about as long."""
        return _kind(self.request.scene, self.request.version, *self.request.settings.view)

    @property
    def give_up_at(self) -> float:
        """time.monotonic() from which on it is given up, s: its deadline, or sooner while none of it has begun."""
        request = self.request
        deadline = math.inf if request.deadline is None else request.deadline
        return deadline if request.begin_by is None or self.memory is not None else min(deadline, request.begin_by)

    @property
    def expired(self) -> bool:
        return time.monotonic() >= self.give_up_at

    @property
    def untouched(self) -> bool:
        """Whether all of it still waits to be rendered."""
        return bool(self.waiting) and self.memory is None and not self.done.done()

    @property
    def reply_memory(self) -> int:
        """The file that holds the reply, once it is done."""
        memory = self.memory if self.archive is None else self.archive
        assert memory is not None
        return memory

    def hand_over(self) -> Place | None:
        """The place of the reply in the caller's own memory, which is the caller's business from now on."""
        place, self.place = self.place, None
        if place is not None:
            self.memory = None
        return place

    def fail(self, error: Exception) -> None:
        if not self.done.done():
            self.done.set_exception(error)


@dataclass(eq=False)
class Part:
    """Poses `first` to `stop` of a ticket, rendered in one go; none of them: the last step, which packs its .npz."""

    ticket: Ticket
    first: int
    stop: int
    attempts: int = 0  # workers that died with it
    kills: int = 0  # of those, the ones that hung and were killed
    work_s: float = 0.0  # that it will take, by forecast

    @property
    def frames(self) -> int:
        return self.stop - self.first

    @property
    def suspect(self) -> bool:
        """Whether it may be what kills the workers: it goes alone."""
        return self.attempts >= _ATTEMPTS_IN_COMPANY or self.kills > 0

    @property
    def packs(self) -> bool:
        """Whether it makes the .npz of what was rendered."""
        return self.first == self.stop

    def for_retry(self, *, hung: bool) -> list[Part]:
        """Itself in halves, so that even slow frames get done between one death and the next."""
        middle = (self.first + self.stop + 1) // 2
        bounds = {(self.first, middle), (middle, self.stop)} if self.frames > 1 else {(self.first, self.stop)}
        return [Part(self.ticket, *one, self.attempts + 1, self.kills + hung) for one in sorted(bounds)]


class WaitingQueue:
    """Tickets with steps that wait: by priority, then in turns between clients, one part of a ticket at a time.

    Batches wait for as long as interactive requests do, but get one part rendered per second at the least, or every
    other one where parts take longer. The limits hold for each priority on its own, so that a flood of batch frames
    leaves room for others. Where there is no room, what came last of whoever waits for the most gives way to who waits
    for less.
    """

    def __init__(
        self,
        limit_frames: int,
        max_batch_poses: int,
        client_limit_frames: int | None = None,
        max_queue_s: float = math.inf,
    ) -> None:
        """`max_queue_s`: an interactive request that others would keep waiting for longer is refused at once."""
        self.workers = 1  # that take from it
        self._limit_frames = limit_frames
        self._client_limit_frames = limit_frames if client_limit_frames is None else client_limit_frames
        self._max_batch_poses = max_batch_poses
        self._max_queue_s = max_queue_s
        self._forecast = Forecast()
        self._turns: dict[Priority, Turns[Ticket]] = {priority: Turns() for priority in Priority}
        self._again: dict[Priority, OrderedDict[Ticket, None]] = {priority: OrderedDict() for priority in Priority}
        self._last_batch_turn = time.monotonic()  # or since when a batch waits
        self._last_priority = Priority.INTERACTIVE  # of what was taken last

    @property
    def frames(self) -> int:
        again = (step.frames for tickets in self._again.values() for ticket in tickets for step in ticket.waiting)
        return sum(turns.frames for turns in self._turns.values()) + sum(again)

    def add(self, ticket: Ticket) -> None:
        """Raises QueueFull where there is no room, or where the ticket would not begin in time.

        A request larger than a limit is taken only while nothing else waits.
        """
        request = ticket.request
        turns = self._turns[request.priority]
        self._require_time(ticket, turns)
        self._make_room(ticket, turns)
        if request.priority is Priority.BATCH and not turns.frames:
            self._last_batch_turn = time.monotonic()
        count, size = len(request.poses), self._poses_together(ticket)
        frame_s = self._forecast.frame_s(ticket.kind)
        for first in range(0, count, size):
            stop = min(first + size, count)
            ticket.waiting.append(Part(ticket, first, stop, work_s=(stop - first) * frame_s))
        turns.enter(request.caller, ticket, count, count * frame_s)

    def put_first(self, step: Part) -> None:
        """Puts a step that was begun and lost ahead of all that waits."""
        ticket = step.ticket
        self._leave(ticket)
        ticket.waiting.appendleft(step)
        again = self._again[ticket.request.priority]
        again[ticket] = None
        again.move_to_end(ticket, last=False)

    def remove(self, ticket: Ticket) -> None:
        self._leave(ticket)
        ticket.waiting.clear()

    def take_batch(self) -> list[Part]:
        """The steps to be done next, together; empty when nothing waits. Drops tickets past their deadline."""
        patient_s = time.monotonic() - self._last_batch_turn
        is_batch_due = patient_s >= _BATCH_PATIENCE_S and self._last_priority is not Priority.BATCH
        for priority in reversed(_PRIORITIES) if is_batch_due else _PRIORITIES:
            while (ticket := next(iter(self._again[priority]), self._turns[priority].first())) is not None:
                if ticket.expired:
                    self.expire(ticket)
                    continue
                step = self._take(ticket)
                batch = [step, *self._take_company(step)]
                self._shed_overtaken()
                return batch
        return []

    def settle(self, steps: Sequence[Part], seconds: float, *, typical: bool) -> None:
        """Takes note of what a worker took for steps together; `typical`: such frames will take as long again."""
        frames = sum(step.frames for step in steps)
        kind = steps[0].ticket.kind
        if frames and (typical or seconds / frames > self._forecast.frame_s(kind)):
            self._forecast.learn(kind, frames, seconds)
        for step in steps:
            request, share = step.ticket.request, step.frames / frames if frames else 1.0
            self._turns[request.priority].charge(request.caller, share * seconds - step.work_s)

    def expire(self, ticket: Ticket) -> None:
        """Fails a ticket that is to be given up, and drops what still waits of it."""
        if ticket.expired:
            self.remove(ticket)
            waited_ms = (time.monotonic() - ticket.submitted) * 1000.0
            if ticket.give_up_at == ticket.request.deadline:
                detail = f"the deadline passed before the frames were rendered ({waited_ms:.0f} ms)"
                ticket.fail(DeadlineExceeded(detail))
            else:
                turns = self._turns[ticket.request.priority]
                ticket.fail(self._refusal(f"the request had not begun after {waited_ms:.0f} ms (max_queue_ms)", turns))

    def _require_time(self, ticket: Ticket, turns: Turns[Ticket]) -> None:
        """Raises QueueFull for a ticket that would begin after its deadline, or too late because of others."""
        request = ticket.request
        left_s = ticket.give_up_at - time.monotonic()
        patience_s = self._max_queue_s if request.priority is Priority.INTERACTIVE else math.inf
        if left_s <= 0.0 or turns.work_s <= min(left_s, patience_s) * self.workers:
            return
        wait_s = turns.wait_s(request.caller, own=True) / self.workers
        if wait_s > left_s:
            limit = f"its deadline{'' if ticket.give_up_at == request.deadline else ' to begin'} is in {left_s:.1f} s"
        elif (wait_s := turns.wait_s(request.caller, own=False) / self.workers) > patience_s:
            limit = f"one is to wait for others for at most {patience_s:g} s"
        else:
            return
        raise self._refusal(f"the request would begin after {wait_s:.1f} s, {limit}", turns)

    def _shed_overtaken(self) -> None:
        """Refuses what waits longer for others than it was to, as others came that had had less, and went before it.

        So much of it, what waits longest first, that the rest can be rendered in time.
        """
        turns = self._turns[Priority.INTERACTIVE]
        if turns.work_s <= self._max_queue_s * self.workers:
            return
        latest = time.monotonic() - self._max_queue_s
        heads = ((max(since, ticket.submitted), ticket) for since, ticket in turns.heads())
        overdue = [(since, ticket) for since, ticket in heads if since < latest and ticket.untouched]
        for _, ticket in sorted(overdue, key=lambda one: one[0]):
            if turns.work_s <= self._max_queue_s * self.workers:
                break
            self.remove(ticket)
            ticket.fail(self._refusal(f"others went before for more than {self._max_queue_s:g} s", turns))

    def _make_room(self, ticket: Ticket, turns: Turns[Ticket]) -> None:
        """Fails what came last of whoever waits for the most, where that is more than what the ticket's caller will.

        Raises QueueFull where there is no such one.
        """
        caller, count = ticket.request.caller, len(ticket.request.poses)
        while (waiting := turns.frames_of(caller.client)) and waiting + count > self._client_limit_frames:
            self._push_out(
                turns.greediest(caller, count, own=True),
                self._refusal(_no_room("of this client", waiting, count, self._client_limit_frames), turns),
            )
        while (waiting := turns.frames) and waiting + count > self._limit_frames:
            self._push_out(
                turns.greediest(caller, count, own=False),
                self._refusal(_no_room("already", waiting, count, self._limit_frames), turns),
            )

    def _push_out(self, last: Ticket | None, refusal: QueueFull) -> None:
        if last is None or not last.untouched:
            raise refusal
        self.remove(last)
        last.fail(refusal)

    def _refusal(self, detail: str, turns: Turns[Ticket]) -> QueueFull:
        """The error that tells when all that waits now will be rendered."""
        return QueueFull(detail, retry_after_s=max(_LEAST_RETRY_S, turns.work_s / self.workers))

    def _has_work(self, priority: Priority) -> bool:
        return bool(self._again[priority]) or self._turns[priority].frames > 0

    def _in_turn(self, priority: Priority) -> Iterator[Ticket]:
        yield from list(self._again[priority])
        yield from self._turns[priority]

    def _leave(self, ticket: Ticket) -> None:
        request = ticket.request
        if self._again[request.priority].pop(ticket, ticket) is not None and ticket.waiting:
            frames, work_s = _sum_of(ticket.waiting)
            self._turns[request.priority].leave(request.caller, ticket, frames, work_s)

    def _take_company(self, first: Part) -> list[Part]:
        if first.suspect or first.packs or isinstance(first.ticket.request.settings, Search):
            return []
        room = self._poses_together(first.ticket) - first.frames
        company: list[Part] = []
        priority = first.ticket.request.priority
        for ticket in list(self._in_turn(priority)) if room > 0 and self._has_work(priority) else ():
            if ticket.kind != first.ticket.kind or ticket.expired:
                continue
            while ticket.waiting and room > 0:
                step = ticket.waiting[0]
                if step.packs or step.frames > room or step.suspect:
                    break
                self._take(ticket)
                company.append(step)
                room -= step.frames
            if room <= 0:
                break
        return company

    def _take(self, ticket: Ticket) -> Part:
        request = ticket.request
        self._last_priority = request.priority
        if request.priority is Priority.BATCH:
            self._last_batch_turn = time.monotonic()
        step = ticket.waiting.popleft()
        turns = self._turns[request.priority]
        if self._again[request.priority].pop(ticket, ticket) is None:
            if ticket.waiting:  # others get their turn before its next part
                turns.enter(request.caller, ticket, *_sum_of(ticket.waiting))
        else:
            turns.serve(request.caller, ticket, step.frames, step.work_s, more=bool(ticket.waiting))
        return step

    def _poses_together(self, ticket: Ticket) -> int:
        """The number of poses in a full batch: fewer for images of more than 512x512 pixels, and for slow ones."""
        share = _BATCH_PRIORITY_SHARE if ticket.request.priority is Priority.BATCH else 1
        settings: Resolved | SliceView | Search = ticket.request.settings
        if isinstance(settings, Search | SliceView):
            return 1
        pixels = settings.height * settings.width * len(settings.outputs)
        fitting = self._max_batch_poses * _FULL_BATCH_PIXELS_PER_POSE // pixels
        if (frame_s := self._forecast.frame_s(ticket.kind)) > 0.0:
            fitting = min(fitting, int(_LONGEST_BATCH_S[ticket.request.priority] / frame_s))
        return max(1, min(self._max_batch_poses // share, fitting))


def _sum_of(steps: Iterable[Part]) -> tuple[int, float]:
    steps = list(steps)
    return sum(step.frames for step in steps), sum(step.work_s for step in steps)


def _no_room(whose: str, waiting: int, count: int, limit: int) -> str:
    return f"{waiting} frames wait {whose} and {count} more would exceed the limit of {limit}; try again shortly"


class Deadlines:
    """Fails tickets at their deadlines, should their frames not be ready, or not begun, by then.

    One timer serves them all: it is set for the earliest, and most tickets are answered before it goes off.
    """

    def __init__(self, queue: WaitingQueue) -> None:
        self._queue = queue
        self._tickets: set[Ticket] = set()
        self._timer: asyncio.TimerHandle | None = None
        self._next_look = math.inf  # time.monotonic(), s

    def watch(self, ticket: Ticket) -> None:
        """From now on; again where its deadline has changed."""
        self._tickets.add(ticket)
        self._look_by(ticket.give_up_at)

    def forget(self, ticket: Ticket) -> None:
        self._tickets.discard(ticket)

    def close(self) -> None:
        if self._timer is not None:
            self._timer.cancel()

    def _look_by(self, at: float) -> None:
        if at < self._next_look:
            self.close()
            self._next_look = at
            self._timer = asyncio.get_running_loop().call_later(max(0.0, at - time.monotonic()), self._look)

    def _look(self) -> None:
        self._next_look = math.inf
        for ticket in list(self._tickets):
            self._queue.expire(ticket)
            if not ticket.done.done():  # it has begun, or the timer was a little early
                self._look_by(ticket.give_up_at)
