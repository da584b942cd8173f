"""Waiting for what another process or thread does, and how long that may take."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import TypeVar

Found = TypeVar("Found")


def wait_until(condition: Callable[[], Found], *, within_s: float = 60, every_s: float = 0.01) -> Found:
    """The first true answer of `condition`; an AssertionError where none comes within `within_s`."""
    end = time.monotonic() + within_s
    while not (found := condition()):
        assert time.monotonic() < end, f"not within {within_s:g} s: last was {found!r}"
        time.sleep(every_s)
    return found


def at_this_load(seconds: float) -> float:
    """A limit of a machine that has nothing else to do, as it stands now: longer where others keep it busy."""
    share = os.getloadavg()[0] / (os.cpu_count() or 1)  # of each core in the last minute
    return seconds * max(1.0, 2.0 * share)
