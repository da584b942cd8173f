from __future__ import annotations

import asyncio
import time

import pytest

from ultragray_service.access.limits import WINDOW_S, Rate


def test_a_client_has_so_many_in_any_second_and_is_told_when_there_are_more() -> None:
    rate = Rate()
    assert [rate.take("alice", 2), rate.take("alice", 2), rate.take("bob", 2)] == [0.0, 0.0, 0.0]
    wait_s = rate.take("alice", 2)
    assert 0.0 < wait_s <= 1.1 * WINDOW_S
    time.sleep(wait_s)
    assert rate.take("alice", 2) == 0.0


def test_several_at_once_are_taken_together_or_not_at_all() -> None:
    rate = Rate()
    assert rate.take("alice", 4, 3) == 0.0
    wait_s = rate.take("alice", 4, 3)
    assert wait_s > 0.0
    assert rate.take("alice", 4, 1) == 0.0  # the refusal took none
    time.sleep(max(wait_s, rate.take("alice", 4, 4)))
    assert rate.take("alice", 4, 4) == 0.0


def test_those_who_wait_are_served_in_the_order_in_which_they_came() -> None:
    async def main() -> list[int]:
        rate, served = Rate(), list[int]()

        async def client(number: int) -> None:
            assert await rate.wait("alice", 2, until=None) == 0.0
            served.append(number)

        await asyncio.gather(*(client(number) for number in range(5)))
        return served

    began = time.monotonic()
    assert asyncio.run(main()) == [0, 1, 2, 3, 4]
    assert time.monotonic() - began >= 2 * WINDOW_S


def test_nobody_waits_for_what_would_come_too_late() -> None:
    async def main() -> float:
        rate = Rate()
        rate.take("alice", 1)
        began = time.monotonic()
        assert await rate.wait("alice", 1, until=began + 0.001) > 0.0
        return time.monotonic() - began

    assert asyncio.run(main()) < WINDOW_S


def test_a_clock_that_is_set_back_keeps_nobody_out(monkeypatch: pytest.MonkeyPatch) -> None:
    rate, now_s = Rate(), time.time()
    monkeypatch.setattr(time, "time", lambda: now_s + 3600.0)
    assert rate.take("alice", 1) == 0.0
    monkeypatch.undo()
    assert rate.take("alice", 1) == 0.0
