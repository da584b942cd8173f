"""The bond of a process to its parent, which it must not outlive."""

from __future__ import annotations

import ctypes
import signal

_PR_SET_PDEATHSIG = 1  # prctl(2)


def end_with_parent(number: signal.Signals) -> None:
    """Has the kernel send this process the signal when its parent dies; a parent that died before goes unnoticed."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)
