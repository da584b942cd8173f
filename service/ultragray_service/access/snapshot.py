"""The copy in memory of what the jobs' database knows of keys, owners and registrations, a second or two old.

Requests are checked against the copy: no frame waits for the database. While the database is away the last copy holds,
and so do the times at which keys expire.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence

import sqlalchemy as sa
from sqlalchemy.exc import SQLAlchemyError

from ultragray.errors import UltragrayError
from ultragray_service.access.keys import KeyStore, KnownKeys, read_keys
from ultragray_workers.jobs.queue.tables import CHANGES
from ultragray_workers.rounds import Rounds

INTERVAL_S = 1.0
_USES_EVERY = 30  # intervals
_COPIED = "keys, owners and registrations"

_log = logging.getLogger("ultragray.access")


class Snapshot:
    """Reads what is copied again whenever something of it changed, in a thread of its own."""

    def __init__(self, engine: sa.Engine, keys: KnownKeys, copies: Sequence[Callable[[sa.Connection], None]]) -> None:
        """Fills `keys`, and calls `copies` to be filled: the first copy is there when this returns.

        Raises DatabaseUnavailable.
        """
        self._engine, self._keys, self._copies = engine, keys, copies
        self._number: int | None = None
        self._is_away = False
        self._stop = threading.Event()
        self.refresh()
        self._thread = threading.Thread(target=self._run, name="access", daemon=True)
        self._thread.start()

    def refresh(self) -> None:
        """Reads what changed since the last call. Raises DatabaseUnavailable."""
        with self._engine.connect() as connection:
            number = connection.execute(sa.select(CHANGES.c.number)).scalar()  # first: what follows is as new or newer
            if number != self._number:
                self._keys.replace(read_keys(connection))
                for copy in self._copies:
                    copy(connection)
                self._number = number

    def close(self) -> None:
        """Ends the thread."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        rounds, round_number = Rounds(f"the watch over {_COPIED}", _log), 0
        while not self._stop.wait(INTERVAL_S):
            round_number += 1
            with rounds.round():
                self._look(notes_uses=round_number % _USES_EVERY == 0)

    def _look(self, *, notes_uses: bool) -> None:
        try:
            self.refresh()
            if notes_uses:
                KeyStore(self._engine).note_uses(self._keys.take_uses())
        except (UltragrayError, SQLAlchemyError) as error:
            if not self._is_away:
                _log.warning(f"{_COPIED} stay as they are for now: {str(error).splitlines()[0]}")
            self._is_away = True
        else:
            if self._is_away:
                _log.warning(f"{_COPIED} are read again")
            self._is_away = False
