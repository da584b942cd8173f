"""Problems in the log: of each kind one in a while, with the number of those that were left out. Free of ROS."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

PERIOD_S = 5.0


class Problems:
    """Passes on what goes wrong, of each reason at most one sentence in PERIOD_S. Threads may share it."""

    def __init__(self, warn: Callable[[str], object]) -> None:
        self._warn = warn
        self._lock = threading.Lock()
        self._told_at: dict[str, float] = {}  # time.monotonic() by reason
        self._left_out: dict[str, int] = {}

    def tell(self, reason: str, sentence: str) -> None:
        """A problem; `reason` is its kind, such as SCENE_NOT_FOUND."""
        now = time.monotonic()
        with self._lock:
            if now - self._told_at.get(reason, -PERIOD_S) < PERIOD_S:
                self._left_out[reason] = self._left_out.get(reason, 0) + 1
                return
            self._told_at[reason] = now
            left_out = self._left_out.pop(reason, 0)
        self._warn(f"{reason}: {sentence}" + (f" ({left_out} more like it since)" if left_out else ""))
