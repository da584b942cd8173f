"""Waiting for what another process or thread does."""

from __future__ import annotations

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
