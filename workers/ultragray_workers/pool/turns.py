"""Turns between clients, and between the connections of each, by the workers' time that each has had.

This is start-time fair queueing (Goyal, Vin, Cheng 1996) on two levels. Every share i, a client or a connection of one,
has a virtual time S_i: the seconds of workers that it was served. The queue has a clock V, the S of the share that was
taken last. The next is the waiting share of the least S_i, of equal ones that with the fewest frames; taking work of
w forecast seconds makes V = S_i, then S_i += w, and S_i += measured - w once it is known what it took. A share that
begins to wait starts at max(S_i, V): nobody saves up time while away, and one that was just served long waits until the
others have had as much. So any two shares that wait all the time get the same within the length of one part each. A
client's connections have a clock of their own and divide what the client gets: opening more of them gains nothing. How
long one more item of share i must wait follows: it is next when S_i has come to T = S_i + w_i, and until then every
other share j is served min(w_j, T - S_j), at least a frame where it is behind (`_Share.before`).
"""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Hashable, Iterator
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any, Generic, TypeVar

Item = TypeVar("Item")

_NO_ITEM: Any = object()
_MOST_IDLE = 256  # shares that are remembered beside those that wait


@dataclass(frozen=True)
class Caller:
    """Who a request comes from, as far as turns go."""

    client: str = ""  # a principal's name where there is one, else an address
    connection: str = ""  # of that client


UNKNOWN_CALLER = Caller()


class _Share:
    """A client or a connection that waits, or that had something not long ago."""

    def __init__(self, served_s: float) -> None:
        self.served_s = served_s  # its virtual time
        self.work_s = 0.0  # what it waits for
        self.frames = 0

    def before(self, served_s: float) -> float:
        """The seconds that it gets before one of such a virtual time is next: a frame's at least, if any."""
        if self.served_s > served_s or not self.frames:
            return 0.0
        return min(self.work_s, max(served_s - self.served_s, self.work_s / self.frames))

    @property
    def turn(self) -> tuple[float, int]:
        """Shares come by it: of those that are as far behind, the one that waits for the fewest frames."""
        return self.served_s, self.frames


class _Connection(_Share, Generic[Item]):
    def __init__(self, served_s: float) -> None:
        super().__init__(served_s)
        self.items: OrderedDict[Item, None] = OrderedDict()
        self.head_since = 0.0  # time.monotonic() since which its first item waits for nothing of its own


class _Client(_Share, Generic[Item]):
    def __init__(self, served_s: float) -> None:
        super().__init__(served_s)
        self.clock_s = 0.0  # of its connections
        self.connections: dict[str, _Connection[Item]] = {}


class Turns(Generic[Item]):
    """Items that wait, each for its caller."""

    def __init__(self) -> None:
        self._clients: dict[str, _Client[Item]] = {}
        self._clock_s = 0.0
        self.work_s = 0.0
        self.frames = 0

    def enter(self, caller: Caller, item: Item, frames: int, work_s: float) -> None:
        """Has so much of an item wait, behind what the same connection waits for already."""
        client, connection = self._shares(caller)
        if not client.frames:
            client.served_s = max(client.served_s, self._clock_s)
        if not connection.frames:
            connection.served_s = max(connection.served_s, client.clock_s)
            connection.head_since = time.monotonic()
        connection.items[item] = None
        self._add(client, connection, frames, work_s)

    def leave(self, caller: Caller, item: Item, frames: int, work_s: float) -> None:
        """Has so much of an item, all that still waits, wait no more."""
        client, connection = self._shares(caller)
        if connection.items.pop(item, item) is None:
            connection.head_since = time.monotonic()
            self._add(client, connection, -frames, -work_s)

    def serve(self, caller: Caller, item: Item, frames: int, work_s: float, *, more: bool) -> None:
        """Takes a part of an item from the queue; with `more` of it the item goes behind the connection's others."""
        client, connection = self._shares(caller)
        self._clock_s, client.clock_s = client.served_s, connection.served_s
        self._add(client, connection, -frames, -work_s)
        self.charge(caller, work_s)
        connection.head_since = time.monotonic()
        if more:
            connection.items.move_to_end(item)
        else:
            del connection.items[item]

    def charge(self, caller: Caller, seconds: float) -> None:
        """Counts what a caller was served, or, below 0, was not served after all."""
        client, connection = self._shares(caller)
        client.served_s += seconds
        connection.served_s += seconds

    def __iter__(self) -> Iterator[Item]:
        """The items in the order of their turns: one of each client and connection, then the next of each."""
        waiting = sorted((c for c in self._clients.values() if c.frames), key=lambda client: client.turn)
        return _alternate([_in_turn(client) for client in waiting])

    def first(self) -> Item | None:
        """The item whose turn is next; None where nothing waits."""
        if not self.frames:
            return None
        client = min((one for one in self._clients.values() if one.frames), key=lambda one: one.turn)
        connection = min((one for one in client.connections.values() if one.items), key=lambda one: one.turn)
        return next(iter(connection.items))

    def heads(self) -> Iterator[tuple[float, Item]]:
        """The first item of each connection, and since when it waits for others only (time.monotonic())."""
        for client in self._clients.values():
            for connection in client.connections.values():
                if connection.items:
                    yield connection.head_since, next(iter(connection.items))

    def frames_of(self, client: str) -> int:
        """Frames for which a client waits."""
        return share.frames if (share := self._clients.get(client)) is not None else 0

    def wait_s(self, caller: Caller, *, own: bool) -> float:
        """How long the workers will be busy before one more item of a caller is next; `own`: with its own work."""
        client, connection = self._shares(caller)
        at = (
            connection.served_s if connection.frames else max(connection.served_s, client.clock_s)
        ) + connection.work_s
        in_client_s = sum(other.before(at) for other in client.connections.values() if other is not connection)
        mine_s = in_client_s + connection.work_s
        at = (client.served_s if client.frames else max(client.served_s, self._clock_s)) + mine_s
        others_s = sum(other.before(at) for other in self._clients.values() if other is not client)
        return others_s + (mine_s if own else in_client_s)

    def greediest(self, caller: Caller, frames: int, *, own: bool) -> Item | None:
        """What came last of the connection that waits for the most, of the client that does; `own`: of the caller's.

        None where that does not have more than the caller would, with so many frames more.
        """
        client, connection = self._shares(caller)
        largest = client if own else max(self._clients.values(), key=lambda share: share.frames)
        other = max(largest.connections.values(), key=lambda share: share.frames)
        if largest is client:
            has_more = other.frames > connection.frames + frames
        else:
            has_more = largest.frames > client.frames + frames
        return next(reversed(other.items)) if has_more else None

    def _shares(self, caller: Caller) -> tuple[_Client[Item], _Connection[Item]]:
        client = self._clients.get(caller.client)
        if client is None:
            _forget_idle(self._clients, self._clock_s)
            client = self._clients[caller.client] = _Client(self._clock_s)
        connection = client.connections.get(caller.connection)
        if connection is None:
            _forget_idle(client.connections, client.clock_s)
            connection = client.connections[caller.connection] = _Connection(client.clock_s)
        return client, connection

    def _add(self, client: _Client[Item], connection: _Connection[Item], frames: int, work_s: float) -> None:
        for share in (self, client, connection):
            share.frames += frames
            share.work_s = share.work_s + work_s if share.frames else 0.0  # rounding does not add up


def _in_turn(client: _Client[Item]) -> Iterator[Item]:
    waiting = sorted((c for c in client.connections.values() if c.items), key=lambda connection: connection.turn)
    return _alternate([iter(list(connection.items)) for connection in waiting])


def _alternate(rows: list[Iterator[Item]]) -> Iterator[Item]:
    """One item of each row, then the next of each, until there are no more."""
    for items in zip_longest(*rows, fillvalue=_NO_ITEM):
        yield from (item for item in items if item is not _NO_ITEM)


def _forget_idle(shares: dict[str, _Client[Item]] | dict[str, _Connection[Item]], clock_s: float) -> None:
    """Forgets those that wait for nothing: first who is no further than the others anyway, then whoever is."""
    if len(shares) < 2 * _MOST_IDLE:
        return
    idle = sorted((name for name, share in shares.items() if not share.frames), key=lambda name: shares[name].served_s)
    for name in idle[: max(0, len(idle) - _MOST_IDLE)]:
        del shares[name]


# How long frames will take, by what those like them have taken.


_FIRST_GUESS_S = 0.005
_MOST_KINDS = 256
_WEIGHT = 0.2  # of the newest measurement


class Forecast:
    """Seconds of a worker per frame, by kind: frames of a scene that share a view."""

    def __init__(self) -> None:
        self._frame_s: OrderedDict[Hashable, float] = OrderedDict()
        self._any_s = _FIRST_GUESS_S

    def frame_s(self, kind: Hashable) -> float:
        return self._frame_s.get(kind, self._any_s)

    def learn(self, kind: Hashable, frames: int, seconds: float) -> None:
        measured_s = seconds / frames
        known_s = self._frame_s.get(kind, measured_s)
        self._frame_s[kind] = known_s + _WEIGHT * (measured_s - known_s)
        self._frame_s.move_to_end(kind)
        self._any_s += _WEIGHT * (measured_s - self._any_s)
        if len(self._frame_s) > _MOST_KINDS:
            self._frame_s.popitem(last=False)
