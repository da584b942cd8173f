"""Long waits in a thread of their own."""

import asyncio
import threading

import pytest

from ultragray_service.core.threads import in_own_thread


def test_results_and_errors_come_back():
    def fail():
        raise KeyError("no")

    async def run():
        assert await in_own_thread(lambda: threading.current_thread().daemon) is True
        with pytest.raises(KeyError):
            await in_own_thread(fail)

    asyncio.run(run())


def test_many_may_wait_and_none_keeps_the_loop_from_ending():
    never = threading.Event()

    async def run():
        waiting = [asyncio.ensure_future(in_own_thread(never.wait)) for _ in range(50)]
        result = await in_own_thread(lambda: 7)
        assert not any(task.done() for task in waiting)
        return result

    assert asyncio.run(run()) == 7
    never.set()
