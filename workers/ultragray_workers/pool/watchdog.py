"""How long a worker may owe an answer, and how it is noticed that one hangs."""

from __future__ import annotations

import time
from dataclasses import dataclass

STUCK_AFTER_S = 5.0  # without a word from a worker that has work: whoever asks whether the service is ready is told


@dataclass(frozen=True)
class Patience:
    """The time that a worker is given."""

    grace_s: float  # to take up a task, and after the deadline of one
    task_s: float  # for a task without a deadline, and to load a scene


class Watch:
    """What is expected of a worker, in time.monotonic() seconds. It costs a task no timer: whoever watches asks."""

    def __init__(self, patience: Patience) -> None:
        self._patience = patience
        self._begun = self._heard = 0.0
        self._deadline: float | None = None
        self._loading = False

    def begin(self, deadline: float | None) -> None:
        """The worker is given a task whose frames somebody waits for until then; None: for as long as it takes."""
        self._begun = self._heard = time.monotonic()
        self._deadline = deadline
        self._loading = False

    def hear(self, loading: bool | None = None) -> None:
        """The worker has told something; `loading`: that it begins to load a scene, or has done so."""
        self._heard = time.monotonic()
        if loading is not None:
            self._loading = loading

    @property
    def quiet_s(self) -> float:
        """How long the worker has told nothing of its task."""
        return time.monotonic() - self._heard

    def complaint(self, taken: bool) -> str | None:
        """The reason to give up on the worker; None while there is none. `taken`: whether it has taken up its task."""
        now, patience = time.monotonic(), self._patience
        if not taken:
            late_s = now - self._begun - patience.grace_s
            return f"it did not take up its task within {patience.grace_s:g} s" if late_s > 0 else None
        if self._loading or self._deadline is None:
            late_s = now - self._heard - patience.task_s
            return f"it told nothing for {patience.task_s:g} s" if late_s > 0 else None
        late_s = now - max(self._deadline, self._heard) - patience.grace_s
        return f"it owed an answer for {patience.grace_s:g} s after the deadline" if late_s > 0 else None
