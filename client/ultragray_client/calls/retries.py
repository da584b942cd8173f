"""The pauses between attempts, and the end of them."""

from __future__ import annotations

import random
import time

from ..errors import ClientError, ResourceExhausted, Unavailable

_FIRST_PAUSE_S = 0.1
_LONGEST_PAUSE_S = 5.0


class Retries:
    """The attempts of one call of the user, which end when the first of two times has passed.

    `timeout_s` counts from now, `patience_s` from the first failure since anything came, for calls that go on for as
    long as they take. None: as long as it takes; a patience of 0: one failure ends it.
    """

    def __init__(
        self, timeout_s: float | None, patience_s: float | None, *, longest_pause_s: float = _LONGEST_PAUSE_S
    ) -> None:
        self._deadline = None if timeout_s is None else time.monotonic() + timeout_s
        self._patience_s = patience_s
        self._longest_pause_s = longest_pause_s
        self.was_unavailable = False  # at any attempt: then it is not known whether that one worked
        self.progress()

    def progress(self) -> None:
        """Something came: the next failure is a first one."""
        self._failing_since: float | None = None
        self._failures = 0

    def remaining_s(self) -> float | None:
        """The deadline of the next attempt, in seconds from now; None: it has none."""
        return None if self._deadline is None else max(self._deadline - time.monotonic(), 0.0)

    @property
    def may_go_on(self) -> bool:
        """Whether any failure may be followed by another attempt."""
        return self._patience_s != 0.0

    def may_help(self, error: ClientError) -> bool:
        """Whether another attempt may succeed after an error."""
        overloaded = isinstance(error, ResourceExhausted) and error.retry_after_s is not None
        return self.may_go_on and (overloaded or isinstance(error, Unavailable))

    def pause_s(self, error: ClientError) -> float:
        """The seconds to wait before the next attempt: exponential, with jitter, after any delay that the service told.

        Raises `error` where another attempt cannot succeed, or would come too late.
        """
        self.was_unavailable |= isinstance(error, Unavailable)
        if not self.may_help(error):
            raise error
        backoff_s = min(_FIRST_PAUSE_S * 2.0**self._failures, self._longest_pause_s)
        pause_s = (error.retry_after_s or 0.0) + backoff_s * random.uniform(0.5, 1.0)
        now = time.monotonic()
        if self._failing_since is None:
            self._failing_since = now
        ends = [self._deadline, None if self._patience_s is None else self._failing_since + self._patience_s]
        if any(end is not None and now + pause_s >= end for end in ends):
            raise error
        self._failures += 1
        return pause_s
