"""Loops that go on whatever a round raises."""

import asyncio
import logging

import pytest

from ultragray_workers.rounds import Rounds

LOG = logging.getLogger("ultragray.test")


def test_a_failure_is_logged_once_with_its_traceback_and_so_is_its_end(caplog):
    rounds = Rounds("the watch", LOG)
    for error in (OSError("no files"), OSError("no files"), ValueError("odd"), None, None):
        with rounds.round():
            if error is not None:
                raise error
    told = [(record.levelname, record.message) for record in caplog.records]
    failed = ("ERROR", "the watch failed, and goes on with its next round")
    assert told == [failed, failed, ("WARNING", "the watch is in order again")]
    assert "OSError: no files" in caplog.text
    assert "Traceback" in caplog.text


async def test_cancelling_ends_a_loop():
    async def loop():
        rounds = Rounds("the watch", LOG)
        while True:
            with rounds.round():
                await asyncio.sleep(3600)

    task = asyncio.ensure_future(loop())
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
