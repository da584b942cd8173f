"""So many of something at once on this service, whoever asks, and room left for others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from ultragray_service.access.principal import caller
from ultragray_workers.errors import QueueFull


class Slots:
    """Half of them are the most that one client has. Its methods belong to one event loop."""

    def __init__(self, count: int, what: str) -> None:
        """`what` takes them, in the plural."""
        self._count, self._what = count, what
        self._taken: Counter[str] = Counter()

    @contextmanager
    def one(self) -> Iterator[None]:
        """One for whoever the running code works for, as long as the body runs. Raises QueueFull."""
        client, most = caller().client, self._count // 2
        if self._taken.total() >= self._count:
            raise QueueFull(f"{self._count} {self._what} are under way already")
        if self._taken[client] >= most:
            raise QueueFull(f"{most} {self._what} of this client are under way already, the most that one may have")
        self._taken[client] += 1
        try:
            yield
        finally:
            self._taken[client] -= 1
            self._taken += Counter()  # without those that have none
