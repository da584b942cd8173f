"""How long frames will take, by what those like them have taken."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable

_FIRST_GUESS_S = 0.005
_MOST_KINDS = 256
_WEIGHT = 0.2  # of the newest measurement


class Forecast:
    """Seconds of a worker per frame, by kind: frames of a scene that share a view."""

    def __init__(self) -> None:
        self._frame_s: OrderedDict[Hashable, float] = OrderedDict()
        self._any_s = _FIRST_GUESS_S

    def frame_s(self, kind: Hashable) -> float:
        """Seconds that a worker will take for a frame."""
        return self._frame_s.get(kind, self._any_s)

    def learn(self, kind: Hashable, frames: int, seconds: float) -> None:
        """Takes note of what a worker took for some frames together."""
        measured_s = seconds / frames
        known_s = self._frame_s.get(kind, measured_s)
        self._frame_s[kind] = known_s + _WEIGHT * (measured_s - known_s)
        self._frame_s.move_to_end(kind)
        self._any_s += _WEIGHT * (measured_s - self._any_s)
        if len(self._frame_s) > _MOST_KINDS:
            self._frame_s.popitem(last=False)
