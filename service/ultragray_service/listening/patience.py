"""How long a transfer may lag behind the least rate."""

from __future__ import annotations


class Patience:
    """An allowance of seconds: time uses it up, bytes refill it, up to where it began.

    A peer that sends or takes at least `min_bytes_per_s` never runs out of it; one that stops does after `limit_s`.
    """

    def __init__(self, min_bytes_per_s: float, limit_s: float) -> None:
        self._min_bytes_per_s = min_bytes_per_s
        self._limit_s = limit_s
        self._left_s = limit_s

    def renew(self) -> None:
        """Begin again: another transfer, or one that does not wait for the peer."""
        self._left_s = self._limit_s

    def is_over(self, moved_bytes: int, elapsed_s: float) -> bool:
        """Whether the peer has been too slow, `elapsed_s` after the last question, with `moved_bytes` since."""
        gained_s = moved_bytes / self._min_bytes_per_s
        self._left_s = min(self._limit_s, self._left_s + gained_s - elapsed_s)
        return self._left_s <= 0.0
