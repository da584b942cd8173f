"""The answers of a latest stream that have come and wait for the caller."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

WINDOW = 2  # answers that may wait for the caller: one is on its way while the other is looked at


class NewestAnswers:
    """Answers in their order; of frames that nobody came for, only the newest one is kept."""

    def __init__(self, skip: Callable[[Any], None]) -> None:
        """`skip` is called with each frame that is not kept."""
        self._skip = skip
        self._waiting: deque[Any] = deque()
        self._skipped = 0

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, answer: Any) -> None:
        """An answer has come. It takes the place of a frame; a refusal that waits is kept, and told before it."""
        if self._waiting and not self._waiting[-1].HasField("error") and not answer.HasField("error"):
            skipped = self._waiting.pop()
            self._skipped += 1 + skipped.dropped
            self._skip(skipped)
        self._waiting.append(answer)

    def take(self) -> Any:
        """The oldest of those that are kept."""
        return self._waiting.popleft()

    def take_skipped(self) -> int:
        """The number of poses without a frame for the caller since the last call: skipped here, and dropped before."""
        skipped, self._skipped = self._skipped, 0
        return skipped
