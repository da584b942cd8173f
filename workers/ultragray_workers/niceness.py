"""Processes that let frames go first."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

_OF_SESSION = Path("/proc/self/autogroup")  # sched(7), "The autogroup feature"


def let_frames_go_first(level: int) -> None:
    """Give this process a nice level from 0 to 19, where it has a lower one; and its session, where it leads one.

    Linux on a desktop or a server without containers shares the processors among sessions first, and nice levels count
    within a session alone: a training in a session of its own would have as much as all of the service.
    """
    os.nice(max(0, level - os.nice(0)))
    if os.getsid(0) == os.getpid():
        with suppress(OSError):  # there is no such sharing here
            _OF_SESSION.write_text(str(level), encoding="ascii")
