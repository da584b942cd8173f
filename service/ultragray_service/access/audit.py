"""The audit log: who did what, from where, to what, with which result; rows that nobody changes, beside the jobs.

What changes something is told one by one, streams at their begin and end. Reads and refusals are counted and told once
a minute, a refusal the first time at once, so that neither a control loop nor an attacker fills the log. Entries are
written in a thread; while the database is away they wait in memory, and what does not fit is counted.
"""

from __future__ import annotations

import asyncio
import json
import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from typing import Any

import sqlalchemy as sa
from sqlalchemy.exc import SQLAlchemyError

from ultragray.contract import described
from ultragray.errors import InvalidArgument, UltragrayError
from ultragray_service.access.principals import iso_time
from ultragray_service.access.rules import Operation
from ultragray_service.errors import LimitReached, PermissionDenied, RateLimited, Unauthenticated
from ultragray_workers.jobs.tables import AUDIT
from ultragray_workers.rounds import Rounds

OK = "OK"
OPENED = "OPENED"
CANCELLED = "CANCELLED"  # the client went away
NOBODY = "-"  # who has shown no key that is known
WRITE_INTERVAL_S = 1.0
TALLY_INTERVAL_S = 60.0
MAX_WAITING = 10_000  # entries, while the database is away
_MAX_TALLIES = 1000  # of one caller in one interval, or of all without a name; more are told as one
_BATCH = 500
_COUNTED = {error.reason for error in (PermissionDenied, Unauthenticated, RateLimited, LimitReached)}
_LONGEST = 256  # characters of what clients name

_log = logging.getLogger("ultragray.audit")


@dataclass(frozen=True)
class Entry:
    who: str
    address: str
    what: str  # an operation of access/rules.py
    target: str  # the scene, dataset or job; empty: none
    result: str  # OK, or the reason of the refusal
    facts: Mapping[str, Any] = field(default_factory=dict, compare=False)
    at_s: float = field(default_factory=time.time, compare=False)  # time.time() in seconds


@dataclass
class Account:
    """One request, call or stream, as it will stand in the log: filled in by the code that works for it."""

    target: str = ""
    result: str = OK
    frames: int = 0


_account: ContextVar[Account | None] = ContextVar("account", default=None)


def account() -> Account:
    """The account of what the running code works for; one that nobody reads where it is the service's own work."""
    return _account.get() or Account()


class DatabaseWatch:
    """Tells the log once that a database is away, and once that it is back."""

    def __init__(self, away: str, back: str, log: logging.Logger) -> None:
        self._away, self._back, self._log = away, back, log
        self._is_away = False

    @contextmanager
    def attempt(self) -> Iterator[None]:
        """The body queries the database; where it fails, it is tried again later."""
        try:
            yield
        except (UltragrayError, SQLAlchemyError) as error:
            if not self._is_away:
                self._log.warning(f"{self._away}: {str(error).splitlines()[0]}")
            self._is_away = True
        else:
            if self._is_away:
                self._log.warning(self._back)
            self._is_away = False


class AuditLog:
    """Takes entries on the thread of the event loop, and writes them in a thread of its own."""

    def __init__(self) -> None:
        self._waiting: deque[Entry] = deque()
        self._tallies: dict[Entry, int] = {}
        self._different: Counter[str] = Counter()  # tallies by callers
        self._lost = 0
        self._database = DatabaseWatch("the audit log waits in memory", "the audit log is written again", _log)
        self._engine: sa.Engine | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="audit", daemon=True)

    def open(self, engine: sa.Engine) -> None:
        self._engine = engine
        self._thread.start()

    def close(self) -> None:
        """Writes what is left, if the database answers."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def tell(self, entry: Entry) -> None:
        if len(self._waiting) >= MAX_WAITING:
            self._lost += 1
        else:
            self._waiting.append(entry)

    def count(self, entry: Entry) -> None:
        """Counts something that happens often; a refusal is told the first time; of nobody without its target."""
        if entry.who == NOBODY:
            entry = replace(entry, target="")
        tally = self._tallies.get(entry)
        if tally is None:
            if self._different[entry.who] >= _MAX_TALLIES:
                entry = Entry(entry.who, "*", "*", "", entry.result)
                tally = self._tallies.get(entry)
            self._different[entry.who] += tally is None
        if tally is None and entry.result != OK:
            self.tell(entry)
            self._tallies[entry] = 0
        else:
            self._tallies[entry] = (tally or 0) + 1

    @contextmanager
    def refusals(self, who: str, address: str, operation: Operation, target: str) -> Iterator[None]:
        try:
            yield
        except UltragrayError as error:
            self.count(Entry(who, address, operation.name, target, error.reason))
            raise

    @contextmanager
    def request(self, who: str, address: str, operation: Operation, target: str) -> Iterator[Account]:
        """Tells of what the body does, or counts it. The body says in its account what became of it."""
        mine, began_s = Account(target), time.monotonic()
        before = _account.set(mine)
        if operation.lasts:
            self.tell(Entry(who, address, operation.name, target, OPENED))
        try:
            yield mine
        except UltragrayError as error:
            mine.result = error.reason
            raise
        except asyncio.CancelledError:
            mine.result = CANCELLED
            raise
        finally:
            _account.reset(before)
            entry = Entry(who, address, operation.name, mine.target, mine.result)
            if operation.lasts:
                seconds = round(time.monotonic() - began_s, 1)
                self.tell(replace(entry, facts={"frames": mine.frames, "seconds": seconds}))
            elif operation.changes and mine.result not in _COUNTED:
                self.tell(entry)
            else:
                self.count(entry)

    def _run(self) -> None:
        tallied_s = time.monotonic()
        rounds = Rounds("the audit log", _log)
        stopping = False
        while not stopping:
            stopping = self._stop.wait(WRITE_INTERVAL_S)
            with rounds.round():
                if stopping or time.monotonic() - tallied_s >= TALLY_INTERVAL_S:
                    tallied_s = time.monotonic()
                    self._tell_tallies()
                with self._database.attempt():
                    self._write()

    def _tell_tallies(self) -> None:
        tallies, self._tallies = self._tallies, {}
        self._different = Counter()
        for entry, count in list(tallies.items()):
            if count:
                self.tell(Entry(entry.who, entry.address, entry.what, entry.target, entry.result, {"count": count}))

    def _write(self) -> None:
        if self._lost and len(self._waiting) < MAX_WAITING:
            lost, self._lost = self._lost, 0
            _log.error(f"{lost} entries of the audit log are lost: there was no room while the database was away")
            self.tell(Entry("*", "*", "audit.lost", "", OK, {"count": lost}))
        assert self._engine is not None
        while self._waiting:
            batch = [self._waiting[index] for index in range(min(_BATCH, len(self._waiting)))]
            with self._engine.begin() as connection:
                connection.execute(sa.insert(AUDIT), [_row(entry) for entry in batch])
            for _ in batch:
                self._waiting.popleft()


def _row(entry: Entry) -> dict[str, Any]:
    return {
        "at_s": entry.at_s,
        "who": _kept(entry.who),
        "address": _kept(entry.address),
        "what": entry.what,
        "target": _kept(entry.target),
        "result": entry.result,
        "facts": json.dumps(entry.facts),
    }


def _kept(text: str) -> str:
    return text[:_LONGEST].encode("utf-8", "replace").decode().replace("\0", "�")


def read_audit(
    engine: sa.Engine, *, since_s: float, who: str | None = None, what: str | None = None, limit: int
) -> list[Entry]:
    """The last entries since a time, oldest first. `what`: an operation, or the kind of thing before its dot."""
    rows = AUDIT.c
    chosen = sa.select(AUDIT).where(rows.at_s >= since_s)
    if who is not None:
        chosen = chosen.where(rows.who == who)
    if what is not None:
        chosen = chosen.where(sa.or_(rows.what == what, rows.what.startswith(f"{what}.", autoescape=True)))
    with engine.connect() as connection:
        records = connection.execute(chosen.order_by(rows.number.desc()).limit(limit)).all()
    return [
        Entry(row.who, row.address, row.what, row.target, row.result, json.loads(row.facts), row.at_s)
        for row in reversed(records)
    ]


DEFAULT_HOURS = 24.0
DEFAULT_ENTRIES = 1000
MAX_HOURS = 24.0 * 366
MAX_ENTRIES = 10_000
_HOUR_S = 3600.0


@dataclass(frozen=True)
class AuditEntry:
    """One line of the audit log."""

    at: str = described("ISO 8601, UTC.")
    who: str = described("The name of the key; -: without a known one.")
    address: str = described("That connected.")
    what: str = described("The operation, such as scene.delete.")
    target: str = described("The scene, dataset or job; empty: none.")
    result: str = described("OK, or the reason of the refusal.")
    facts: Mapping[str, Any] = described("Such as count or frames.", factory=dict)

    @classmethod
    def of(cls, entry: Entry) -> AuditEntry:
        return cls(iso_time(entry.at_s), entry.who, entry.address, entry.what, entry.target, entry.result, entry.facts)


@dataclass(frozen=True)
class AuditEntries:
    """The last lines of the audit log."""

    entries: list[AuditEntry] = described("Oldest first.")


async def audit_entries(
    engine: sa.Engine, *, since_hours: float, who: str | None, what: str | None, limit: int
) -> AuditEntries:
    if not 0.0 < since_hours <= MAX_HOURS:
        raise InvalidArgument(f"since_hours must be above 0 and at most {MAX_HOURS:g}", field="since_hours")
    if not 1 <= limit <= MAX_ENTRIES:
        raise InvalidArgument(f"limit must be an integer from 1 to {MAX_ENTRIES}, got {limit}", field="limit")
    since_s = time.time() - since_hours * _HOUR_S
    entries = await asyncio.to_thread(read_audit, engine, since_s=since_s, who=who, what=what, limit=limit)
    return AuditEntries([AuditEntry.of(entry) for entry in entries])
