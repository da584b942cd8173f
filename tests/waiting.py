"""Waiting for what another process or thread does, and how long that may take."""

import asyncio
import os
import time
from pathlib import Path


class Deadline:
    """So many seconds from now, of a machine that has nothing else to do; later as long as others keep it busy."""

    def __init__(self, seconds):
        self._began = time.monotonic()
        self._seconds = seconds

    @property
    def passed(self):
        elapsed = time.monotonic() - self._began
        return elapsed > self._seconds and elapsed > at_this_load(self._seconds)


def wait_until(condition, *, within_s=300, every_s=0.01):
    """The first true answer of `condition`; an AssertionError where none comes before the Deadline of `within_s`."""
    deadline = Deadline(within_s)
    while not (found := condition()):
        assert not deadline.passed, f"not within {within_s:g} s: last was {found!r}"
        time.sleep(every_s)
    return found


class SkippingLoop(asyncio.SelectorEventLoop):
    """An event loop whose time goes on to the next thing that is due whenever there is nothing to do."""

    now = 1000.0

    def time(self):
        return self.now

    def _run_once(self):
        self.now += 1e-6  # no clock stands still while there is something to do
        if not self._ready and self._scheduled:
            self.now = max(self.now, self._scheduled[0].when())
        super()._run_once()


def at_this_load(seconds):
    """A limit of a machine that has nothing else to do, as it stands now: longer where others keep it busy."""
    average, _, _, running, _ = Path("/proc/loadavg").read_text(encoding="ascii").split()  # the first: of a minute
    now = int(running.partition("/")[0]) - 1  # without this process; the average lags behind
    busy = max(float(average), now)
    return seconds * max(1.0, 2.0 * busy / (os.cpu_count() or 1))
