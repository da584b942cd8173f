"""The pauses between attempts, and the end of them."""

from __future__ import annotations

import random
import time

from ..errors import ClientError, ResourceExhausted, Unavailable

_FIRST_PAUSE_S = 0.1
_LONGEST_PAUSE_S = 5.0


class Retries:
    """The attempts of one call of the user, which all end within `timeout_s`.

    Without `timeout_s`, for calls that go on for as long as they take, they end `patience_s` after the first failure
    since anything came.
    """

    def __init__(self, timeout_s: float | None, patience_s: float) -> None:
        self._deadline = None if timeout_s is None else time.monotonic() + timeout_s
        self._patience_s = patience_s
        self.was_unavailable = False  # at any attempt: then it is not known whether that one worked
        self.progress()

    def progress(self) -> None:
        """Something came: the next failure is a first one."""
        self._failing_since: float | None = None
        self._failures = 0

    def remaining_s(self) -> float | None:
        """The deadline of the next attempt, in seconds from now; None: it has none."""
        return None if self._deadline is None else max(self._deadline - time.monotonic(), 0.0)

    def pause_s(self, error: ClientError) -> float:
        """The seconds to wait before the next attempt: exponential, with jitter, after any delay that the service told.

        Raises `error` where another attempt cannot succeed, or would come too late.
        """
        self.was_unavailable |= isinstance(error, Unavailable)
        overloaded = isinstance(error, ResourceExhausted) and error.retry_after_s is not None
        if not overloaded and not isinstance(error, Unavailable):
            raise error
        backoff_s = min(_FIRST_PAUSE_S * 2.0**self._failures, _LONGEST_PAUSE_S)
        pause_s = (error.retry_after_s or 0.0) + backoff_s * random.uniform(0.5, 1.0)
        now = time.monotonic()
        if self._failing_since is None:
            self._failing_since = now
        end = self._failing_since + self._patience_s if self._deadline is None else self._deadline
        if now + pause_s >= end:
            raise error
        self._failures += 1
        return pause_s
