"""The answers of a latest stream that have come and wait for the caller."""

from __future__ import annotations

from collections import deque

from .pose_exchange import Answer


class NewestAnswers:
    """Answers in their order; of frames that nobody came for, only the newest one is kept."""

    def __init__(self) -> None:
        self._waiting: deque[Answer] = deque()
        self._skipped = 0

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, answer: Answer) -> None:
        """An answer has come. It takes the place of a frame; a refusal that waits is kept, and told before it."""
        if self._waiting and not any(one.message.HasField("error") for one in (self._waiting[-1], answer)):
            skipped = self._waiting.pop()
            self._skipped += 1 + skipped.message.dropped
            skipped.skip()
        self._waiting.append(answer)

    def take(self) -> Answer:
        """The oldest of those that are kept."""
        return self._waiting.popleft()

    def take_skipped(self) -> int:
        """The number of poses without a frame for the caller since the last call: skipped here, and dropped before."""
        skipped, self._skipped = self._skipped, 0
        return skipped
