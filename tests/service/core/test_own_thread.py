"""Long waits in a thread of their own."""

import asyncio
import threading

from ultragray_service.core.threads import in_own_thread


def test_many_may_wait_and_none_keeps_the_loop_from_ending():
    never = threading.Event()

    async def run():
        waiting = [asyncio.ensure_future(in_own_thread(never.wait)) for _ in range(50)]
        result = await in_own_thread(lambda: 7)
        assert not any(task.done() for task in waiting)
        return result

    assert asyncio.run(run()) == 7
    never.set()
