"""The order of what waits, without processes."""

import asyncio
import time
from dataclasses import replace

import numpy as np
import pytest

from ultragray.rendering.settings import Encoding
from ultragray.rendering.volumes import SliceView
from ultragray_workers import Priority
from ultragray_workers.errors import DeadlineExceeded, QueueFull
from ultragray_workers.pool.waiting import Deadlines, Part, Ticket, WaitingQueue

from ..asking import asking


@pytest.fixture
def make_ticket():
    loop = asyncio.new_event_loop()

    def make(poses=1, *, scene="a", height=64, **changes):
        request = asking(scene, np.tile(np.eye(4), (poses, 1, 1)), height=height, width=64, **changes)
        return Ticket(request, "a.ugr", done=loop.create_future(), submitted=time.monotonic())

    yield make
    loop.close()


def taken(queue):
    """The next batch as (ticket, first, stop)."""
    return [(part.ticket, part.first, part.stop) for part in queue.take_batch()]


def test_large_requests_take_turns_with_small_ones(make_ticket):
    queue = WaitingQueue(limit_frames=100, max_batch_poses=4)
    large, small = make_ticket(10), make_ticket(4, scene="b")
    queue.add(large)
    queue.add(small)
    assert queue.frames == 14
    turns = [taken(queue) for _ in range(4)]
    assert turns == [[(large, 0, 4)], [(small, 0, 4)], [(large, 4, 8)], [(large, 8, 10)]]
    assert taken(queue) == []
    assert queue.frames == 0


def test_only_what_can_be_rendered_together_is(make_ticket):
    queue = WaitingQueue(limit_frames=100, max_batch_poses=4)
    first, other_size, other_scene, alike, batch, too_many = (
        make_ticket(),
        make_ticket(height=32),
        make_ticket(scene="b"),
        make_ticket(2),
        make_ticket(priority=Priority.BATCH),
        make_ticket(2),
    )
    for ticket in (first, other_size, other_scene, alike, batch, too_many):
        queue.add(ticket)
    assert taken(queue) == [(first, 0, 1), (alike, 0, 2)]
    assert [batch[0][0] for batch in (taken(queue), taken(queue), taken(queue), taken(queue))] == [
        other_size,
        other_scene,
        too_many,
        batch,
    ]


def test_batches_get_a_part_rendered_now_and_then(make_ticket, clock):
    queue = WaitingQueue(limit_frames=100, max_batch_poses=4)
    batch = make_ticket(2, priority=Priority.BATCH)
    interactive = [make_ticket(scene=name) for name in "abc"]
    for ticket in (batch, *interactive):
        queue.add(ticket)
    assert taken(queue) == [(interactive[0], 0, 1)]
    clock.now += 1.1
    assert taken(queue) == [(batch, 0, 1)]
    assert taken(queue) == [(interactive[1], 0, 1)]


def test_slow_batches_let_interactive_requests_pass_between_their_parts(make_ticket, clock):
    queue = WaitingQueue(limit_frames=100, max_batch_poses=4)
    batch = make_ticket(3, priority=Priority.BATCH)
    interactive = [make_ticket(scene=name) for name in "ab"]
    queue.add(batch)
    for ticket in interactive:
        queue.add(ticket)
    order = []
    for _ in range(5):
        clock.now += 2.0  # each part takes so long
        order += [part.ticket for part in queue.take_batch()]
    assert order == [batch, interactive[0], batch, interactive[1], batch]


def test_pieces_of_slices_go_alone(make_ticket):
    queue = WaitingQueue(limit_frames=100, max_batch_poses=4)
    for _ in range(2):
        ticket = make_ticket()
        piece = SliceView("echo", 8, 8, 0.1, Encoding.FLOAT32)
        ticket.request = replace(ticket.request, settings=piece)
        queue.add(ticket)
    assert [len(queue.take_batch()) for _ in range(3)] == [1, 1, 0]


def test_large_images_make_smaller_batches(make_ticket):
    queue = WaitingQueue(limit_frames=100, max_batch_poses=4)
    ticket = make_ticket(4, height=512 * 8 * 2)  # 64 wide: twice the pixels of 512x512
    queue.add(ticket)
    assert taken(queue) == [(ticket, 0, 2)]


@pytest.mark.parametrize(
    ("priority", "frame_s", "together"),
    [("INTERACTIVE", 0.01, 2), ("INTERACTIVE", 1.0, 1), ("BATCH", 0.02, 2), ("BATCH", 0.002, 4)],
)
def test_slow_frames_make_smaller_batches(make_ticket, priority, frame_s, together):
    queue = WaitingQueue(limit_frames=100, max_batch_poses=16)
    before, ticket = (make_ticket(poses, priority=Priority[priority]) for poses in (1, 32))
    queue.add(before)
    for _ in range(30):
        queue.settle(queue.take_batch() or [Part(before, 0, 1)], frame_s, typical=True)
    queue.add(ticket)
    assert taken(queue) == [(ticket, 0, together)]


def test_the_limit_counts_poses_of_each_priority(make_ticket):
    queue = WaitingQueue(limit_frames=4, max_batch_poses=4)
    queue.add(make_ticket(10))  # larger than the limit, but nothing else waits
    with pytest.raises(QueueFull, match="10 frames wait"):
        queue.add(make_ticket())
    queue.add(make_ticket(4, priority=Priority.BATCH))
    with pytest.raises(QueueFull):
        queue.add(make_ticket(priority=Priority.BATCH))


def test_lost_work_comes_first_and_suspects_go_alone(make_ticket):
    queue = WaitingQueue(limit_frames=100, max_batch_poses=4)
    lost, others = make_ticket(4), [make_ticket() for _ in range(2)]
    queue.add(lost)
    (part,) = queue.take_batch()
    for ticket in others:
        queue.add(ticket)
    for again in reversed(part.for_retry(hung=False)):
        queue.put_first(again)
    assert taken(queue) == [(lost, 0, 2), (others[0], 0, 1), (others[1], 0, 1)]
    assert taken(queue) == [(lost, 2, 4)]
    for work in (Part(others[0], 0, 1), Part(lost, 0, 2, attempts=2), Part(others[1], 0, 1)):
        queue.put_first(work)
    assert taken(queue) == [(others[1], 0, 1), (others[0], 0, 1)]
    assert taken(queue) == [(lost, 0, 2)]


def test_what_is_past_its_deadline_is_dropped(make_ticket):
    queue = WaitingQueue(limit_frames=100, max_batch_poses=4)
    late, company = make_ticket(deadline=time.monotonic() - 1), make_ticket()
    queue.add(late)
    queue.add(company)
    assert taken(queue) == [(company, 0, 1)]
    assert isinstance(late.done.exception(), DeadlineExceeded)
    assert queue.frames == 0


@pytest.mark.parametrize("first_s", [60.0, 0.02], ids=["brought forward", "put off"])
def test_a_deadline_that_was_moved_expires_when_it_says_now(make_ticket, clock, first_s):
    async def wait():
        queue = WaitingQueue(limit_frames=100, max_batch_poses=1)
        deadlines = Deadlines(queue)
        ticket = make_ticket(deadline=time.monotonic() + first_s)
        queue.add(ticket)
        deadlines.watch(ticket)
        ticket.request = replace(ticket.request, deadline=time.monotonic() + 0.1)
        deadlines.watch(ticket)
        await asyncio.sleep(0.05)
        assert queue.frames == 1
        await asyncio.sleep(0.1)
        assert queue.frames == 0
        assert isinstance(ticket.done.exception(), DeadlineExceeded)

    clock.run_until_complete(wait())


@pytest.mark.usefixtures("clock")
def test_what_cannot_begin_in_time_is_refused_at_once_and_told_when_it_could(make_ticket):
    queue = WaitingQueue(limit_frames=100, max_batch_poses=1)
    queue.settle([Part(make_ticket(), 0, 1)], 10.0, typical=True)
    queue.add(make_ticket())
    with pytest.raises(QueueFull, match=r"would begin after 10\.0 s, its deadline to begin is in 5\.0 s") as caught:
        queue.add(make_ticket(begin_by=time.monotonic() + 5.0, deadline=time.monotonic() + 60.0))
    assert caught.value.retry_after_s == pytest.approx(10.0)
    queue.add(make_ticket(begin_by=time.monotonic() + 15.0))


def test_what_has_not_begun_in_time_is_refused_and_what_has_goes_on(make_ticket, clock):
    async def main():
        queue = WaitingQueue(limit_frames=100, max_batch_poses=1)
        begun, waits = make_ticket(2), make_ticket()
        deadlines = Deadlines(queue)
        for ticket in (begun, waits):
            ticket.request = replace(ticket.request, begin_by=time.monotonic() + 0.2)
            ticket.done = asyncio.get_running_loop().create_future()
            queue.add(ticket)
            deadlines.watch(ticket)
        begun.memory = 0  # a worker has the first part of it
        with pytest.raises(QueueFull, match="max_queue_ms"):
            await waits.done
        assert not begun.done.done()
        assert queue.frames == 2
        deadlines.close()

    clock.run_until_complete(main())
