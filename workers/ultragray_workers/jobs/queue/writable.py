"""Whether the database of the jobs takes changes now: a row is written and taken back.

To read, or to write nothing, would not tell: a SQLite file that was removed is read to the end of the process, a full
or read-only disk shows with the first page, and a standby of PostgreSQL answers every question.
"""

from __future__ import annotations

import os
import uuid

import sqlalchemy as sa
from sqlalchemy.exc import SQLAlchemyError

from ultragray_workers.errors import DatabaseUnavailable
from ultragray_workers.jobs.queue.tables import WORKERS


class WriteProbe:
    """The check of one database, from the time on when it was opened."""

    def __init__(self, engine: sa.Engine) -> None:
        self._engine = engine
        self._file = engine.url.database if engine.dialect.name == "sqlite" else None
        if self._file is not None:
            self._opened = _identity(self._file)
            # SQLite would make an empty file in place of one that was removed.
            sa.event.listen(engine, "do_connect", lambda *_: self._require_same_file())

    def check(self) -> None:
        """Raises DatabaseUnavailable, StorageFull."""
        self._require_same_file()
        try:
            with self._engine.connect() as connection:  # whose end takes the row back
                connection.execute(sa.insert(WORKERS).values(executor=f"check {uuid.uuid4().hex}", seen_at_s=0.0))
        except SQLAlchemyError as error:
            raise DatabaseUnavailable("the database of the jobs refuses to write") from error

    def _require_same_file(self) -> None:
        if self._file is not None and _identity(self._file) != self._opened:
            raise DatabaseUnavailable(
                "the file of the jobs' database was removed or replaced while it was in use: put it back, or start the "
                "service again"
            )


def _identity(file: str) -> tuple[int, int] | None:
    """Of the file that stands at the path; None: there is none."""
    try:
        found = os.stat(file)
    except OSError:
        return None
    return found.st_dev, found.st_ino
