"""What the processes of the service owe each other: none outlives its parent, and frames go first."""

from __future__ import annotations

import ctypes
import os
import random
import signal
import time
from pathlib import Path

_PR_SET_PDEATHSIG = 1  # prctl(2)


def end_with_parent(number: signal.Signals) -> None:
    """Has the kernel send this process the signal when its parent dies; a parent that died before goes unnoticed."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)


# Processes that let frames go first.


_OF_SESSION = Path("/proc/self/autogroup")  # sched(7), "The autogroup feature"
_TRIES = 20


def let_frames_go_first(level: int) -> None:
    """Raise this process to a nice level from 0 to 19, and its session with it where it leads one.

    Linux on a desktop or a server without containers shares the processors among sessions first, and nice levels count
    within a session alone: a training in a session of its own would have as much as all of the service.
    """
    os.nice(max(0, level - os.nice(0)))
    if os.getsid(0) == os.getpid():
        _raise_session(level)


def _raise_session(level: int) -> None:
    """Raise the session of this process, where Linux has such sharing and takes a change of it."""
    for _ in range(_TRIES):
        try:
            _OF_SESSION.write_text(str(level), encoding="ascii")
        except BlockingIOError:  # without CAP_SYS_ADMIN, one write in 0.1 s from all processes together
            time.sleep(random.uniform(0.05, 0.25))
        except OSError:
            return
        else:
            return
