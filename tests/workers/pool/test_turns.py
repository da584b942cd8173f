"""Fair turns between clients and their connections, and the refusal of what would wait too long: without processes."""

import asyncio
import itertools
import math
import time

import numpy as np
import pytest

from ultragray_workers import Priority
from ultragray_workers.errors import QueueFull
from ultragray_workers.pool.turns import Caller, Forecast, Turns
from ultragray_workers.pool.waiting import Ticket, WaitingQueue

from ..asking import asking

FRAME_S = 0.01


@pytest.fixture
def make_ticket():
    loop = asyncio.new_event_loop()

    def make(client="", connection="", *, poses=1, scene="a", **changes):
        caller = Caller(client, connection)
        request = asking(scene, np.tile(np.eye(4), (poses, 1, 1)), height=64, width=64, caller=caller, **changes)
        return Ticket(request, "a.ugr", done=loop.create_future(), submitted=time.monotonic())

    yield make
    loop.close()


def queue_of(limit_frames=10_000, max_batch_poses=1, **limits):
    return WaitingQueue(limit_frames, max_batch_poses, **limits)


def rendered(queue, count, frame_s=FRAME_S):
    """Who gets the next frames, each of which takes so long (by scene)."""
    order = []
    for _ in range(count):
        steps = queue.take_batch()
        if not steps:
            break
        scene = steps[0].ticket.request.scene
        queue.settle(steps, len(steps) * (frame_s[scene] if isinstance(frame_s, dict) else frame_s), typical=True)
        order += [step.ticket.request.caller for step in steps]
    return order


def test_one_polite_client_beside_a_greedy_one_gets_every_other_frame(make_ticket):
    queue = queue_of()
    for _ in range(200):
        queue.add(make_ticket("greedy"))
    for _ in range(10):
        queue.add(make_ticket("polite"))
    order = [caller.client for caller in rendered(queue, 20)]
    assert order.count("polite") >= 9


def test_more_connections_do_not_get_a_client_more(make_ticket):
    queue = queue_of()
    for connection, _ in itertools.product(range(100), range(3)):
        queue.add(make_ticket("greedy", str(connection)))
    for _ in range(50):
        queue.add(make_ticket("polite", "only"))
    order = [caller.client for caller in rendered(queue, 60)]
    assert 28 <= order.count("polite") <= 32


def test_connections_of_one_client_share_what_it_gets(make_ticket):
    queue = queue_of()
    for connection, _ in itertools.product("abcd", range(25 * 2)):
        queue.add(make_ticket("one", connection))
    connections = [caller.connection for caller in rendered(queue, 40)]
    assert {connections.count(connection) for connection in "abcd"} == {10}


def test_whoever_asks_for_less_than_its_share_is_served_at_once(make_ticket):
    """One connection with a request now and then, beside 50 streams of the same client that always wait."""
    queue = queue_of()
    rendered(queue, 1)
    for connection, _ in itertools.product(range(50), range(10)):
        queue.add(make_ticket("all", f"greedy {connection}"))
    for _ in range(5):
        rendered(queue, 60)
        queue.add(make_ticket("all", "polite"))
        assert "polite" in [caller.connection for caller in rendered(queue, 3)]


def test_idle_time_is_not_saved_up(make_ticket):
    queue = queue_of()
    for _ in range(100):
        queue.add(make_ticket("busy"))
    rendered(queue, 50)
    for _ in range(50):
        queue.add(make_ticket("late"))
    order = [caller.client for caller in rendered(queue, 20)]
    assert 9 <= order.count("late") <= 11


def test_turns_are_of_time_so_that_costly_frames_come_less_often(make_ticket):
    queue = queue_of()
    frame_s = {"costly": 1.0, "cheap": 0.01}
    for _ in range(100):
        queue.add(make_ticket("a", scene="costly"))
    for _ in range(1000):
        queue.add(make_ticket("b", scene="cheap"))
    order = [caller.client for caller in rendered(queue, 205, frame_s)]
    assert order.count("a") <= 5
    assert order.count("b") >= 200


@pytest.mark.usefixtures("batches_of_any_length")
def test_company_is_taken_in_turns(make_ticket):
    queue = queue_of(max_batch_poses=8)
    for _ in range(50):
        queue.add(make_ticket("greedy"))
    for _ in range(50):
        queue.add(make_ticket("polite"))
    clients = [step.ticket.request.caller.client for step in queue.take_batch()]
    assert len(clients) == 8
    assert clients.count("polite") == 4


def test_what_would_wait_for_others_too_long_is_refused_and_told_when_to_come_back(make_ticket):
    queue = queue_of(max_queue_s=0.5)
    queue.add(make_ticket())
    rendered(queue, 1)
    told_s = []
    for connection, _ in itertools.product(range(200), range(3)):
        try:
            queue.add(make_ticket("all", str(connection)))
        except QueueFull as refusal:
            waiting_s = queue.frames * FRAME_S
            told_s.append(refusal.retry_after_s / waiting_s)
    assert len(told_s) > 300
    assert told_s == pytest.approx([1.0] * len(told_s), rel=0.01)
    assert 0.4 < queue.frames * FRAME_S < 1.5  # those who came first had more than one let in
    queue.add(make_ticket("other"))  # whose turn comes at once
    queue.workers = 100
    queue.add(make_ticket("all", "0"))  # which now take a hundredth of the time


def test_a_client_alone_waits_for_itself_as_long_as_it_likes(make_ticket):
    queue = queue_of(max_queue_s=0.5)
    queue.add(make_ticket())
    rendered(queue, 1)
    for _ in range(500):
        queue.add(make_ticket("alone", "its stream"))
    assert queue.frames == 500


@pytest.mark.usefixtures("clock")
def test_what_cannot_begin_before_its_deadline_is_refused_at_once(make_ticket):
    queue = queue_of()
    queue.add(make_ticket())
    rendered(queue, 1)
    for _ in range(100):  # a second
        queue.add(make_ticket(deadline=time.monotonic() + 60.0))
    with pytest.raises(QueueFull, match=r"would begin after 1\.0 s, its deadline is in 0\.5 s"):
        queue.add(make_ticket(deadline=time.monotonic() + 0.5))
    queue.add(make_ticket(deadline=time.monotonic() + 5.0))
    queue.add(make_ticket(priority=Priority.BATCH, deadline=time.monotonic() + 0.5))  # nothing of its kind waits


def test_the_limit_of_a_client_leaves_room_for_others(make_ticket):
    queue = queue_of(limit_frames=10, client_limit_frames=6)
    for _ in range(6):
        queue.add(make_ticket("greedy"))
    with pytest.raises(QueueFull, match="6 frames wait of this client and 1 more would exceed the limit of 6"):
        queue.add(make_ticket("greedy"))
    for _ in range(4):
        queue.add(make_ticket("polite"))
    assert queue.frames == 10


def test_in_a_full_queue_the_greediest_gives_way(make_ticket):
    queue = queue_of(limit_frames=10)
    greedy = [make_ticket("greedy", "a") for _ in range(9)]
    for ticket in greedy:
        queue.add(ticket)
    queue.add(make_ticket("polite"))
    queue.add(make_ticket("polite"))
    assert isinstance(greedy[-1].done.exception(), QueueFull)  # what came last of it
    assert not greedy[-2].done.done()
    with pytest.raises(QueueFull):
        queue.add(make_ticket("greedy", "a"))
    queue.add(make_ticket("third", poses=3))
    assert queue.frames == 10
    with pytest.raises(QueueFull):  # nobody has more than it would have
        queue.add(make_ticket("fourth", poses=9))


def test_a_connection_gives_way_to_another_of_its_client(make_ticket):
    queue = queue_of(client_limit_frames=10)
    greedy = [make_ticket("one", "greedy") for _ in range(10)]
    for ticket in greedy:
        queue.add(ticket)
    queue.add(make_ticket("one", "polite"))
    assert isinstance(greedy[-1].done.exception(), QueueFull)
    assert queue.frames == 10


def test_many_callers_that_come_and_go_are_forgotten():
    turns = Turns()
    for number in range(5000):
        caller = Caller(str(number), "x")
        turns.enter(caller, number, 1, FRAME_S)
        turns.serve(caller, number, 1, FRAME_S, more=False)
        caller = Caller("same", str(number))
        turns.enter(caller, number, 1, FRAME_S)
        turns.leave(caller, number, 1, FRAME_S)
    assert (turns.frames, turns.work_s) == (0, 0.0)
    assert len(turns._clients) <= 1024
    assert len(turns._clients["same"].connections) <= 1024


def test_a_forecast_follows_what_frames_take():
    forecast = Forecast()
    first_guess_s = forecast.frame_s("a")
    assert 0.0 < first_guess_s < 0.1
    forecast.learn("a", 10, 1.0)
    assert forecast.frame_s("a") == pytest.approx(0.1)
    assert first_guess_s < forecast.frame_s("b") < 0.1  # of which nothing is known: some of what others take
    for _ in range(30):
        forecast.learn("a", 1, 0.01)
    assert forecast.frame_s("a") == pytest.approx(0.01, rel=0.1)
    for number in range(1000):
        forecast.learn(number, 1, 0.02)
    assert forecast.frame_s("a") == pytest.approx(0.02)  # forgotten
    assert math.isfinite(forecast.frame_s("anything"))


def test_what_is_overtaken_for_too_long_is_refused_not_kept(make_ticket, clock):
    """Others come again and again that have had less: an early request must not wait until all of them had theirs."""
    queue = queue_of(max_queue_s=4.5 * FRAME_S)
    names = [f"early {number}" for number in range(4)]
    for name in names:
        queue.add(make_ticket("all", name))
    rendered(queue, len(names))
    early = [make_ticket("all", name) for name in names]
    for ticket in early:
        queue.add(ticket)
    began, others = clock.now, itertools.count()
    while not early[0].done.done() and clock.now < began + 30:
        while queue.frames < 2 * len(names):
            queue.add(make_ticket("all", f"other {next(others)}"))
        assert [caller.connection for caller in rendered(queue, 1)] != ["early 0"]
        clock.now += FRAME_S
    assert isinstance(early[0].done.exception(), QueueFull)
    assert clock.now - began >= 4.5 * FRAME_S
