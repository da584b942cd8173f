"""The workers that are alive: a small table beside the queue, and the take-over of the jobs of those that are not.

DBOS hands a dead worker's jobs to nobody. Here each worker beats every second, by the clock of the database, and puts
the jobs of workers that have not beaten for a while back into the queue. It does the same with jobs of its own that it
does not run: DBOS forgets a job whose end it cannot write, such as on a full disk.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from contextlib import suppress

import sqlalchemy as sa
from sqlalchemy.exc import SQLAlchemyError

from ultragray.errors import UltragrayError

from . import database
from .database import JobDatabase

BEAT_INTERVAL_S = 1.0
DEAD_AFTER_S = 10.0
_LOOK_EVERY_BEATS = 2
_FORGET_AFTER_S = 86_400.0

_log = logging.getLogger("ultragray.jobs")

_workers = sa.Table(
    "ultragray_workers",
    sa.MetaData(),
    sa.Column("executor", sa.Text, primary_key=True),
    sa.Column("seen_at_s", sa.Double, nullable=False),
)


class Heartbeat:
    """The life sign of one worker, and its watch over the others."""

    def __init__(self, jobs: JobDatabase, executor: str, job_at_hand: Callable[[], str | None]) -> None:
        """The first beat is done when this returns."""
        self._database, self._executor, self._job_at_hand = jobs, executor, job_at_hand
        self._forgotten: set[str] = set()  # own jobs that were not running at the last look
        self._look_at_s = float("-inf")
        self._stop = threading.Event()
        with jobs.engine.begin() as connection:
            connection.execute(sa.schema.CreateTable(_workers, if_not_exists=True))
        self.beat()
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)
        self._thread.start()

    def beat(self) -> None:
        """Writes that the worker is alive."""
        now_s = self._now_s()
        with self._database.engine.begin() as connection:
            mine = _workers.c.executor == self._executor
            if not connection.execute(sa.update(_workers).where(mine).values(seen_at_s=now_s)).rowcount:
                connection.execute(sa.insert(_workers).values(executor=self._executor, seen_at_s=now_s))

    def take_over(self) -> list[str]:
        """Puts the jobs that no living worker runs back into the queue, and returns their ids."""
        running = [row for row in self._database.unfinished() if row.status in database.RUNNING]
        mine = {row.workflow_id for row in running if row.executor_id == self._executor} - {self._job_at_hand()}
        twice, self._forgotten = mine & self._forgotten, mine
        if not running:
            return []
        alive = self._alive() | {self._executor}
        taken = [
            row.workflow_id
            for row in running
            if (row.executor_id not in alive or row.workflow_id in twice)
            and self._database.put_back(row.workflow_id, row.executor_id or "")
        ]
        for job_id in taken:
            _log.warning(f"no worker is at the job {job_id} any more: it waits again")
        return taken

    def stop(self) -> None:
        """Ends the beats: from now on the others take the worker for gone."""
        self._stop.set()
        self._thread.join()
        with suppress(UltragrayError, SQLAlchemyError), self._database.engine.begin() as connection:
            connection.execute(sa.delete(_workers).where(_workers.c.executor == self._executor))

    def _alive(self) -> set[str]:
        with self._database.engine.begin() as connection:
            connection.execute(sa.delete(_workers).where(_workers.c.seen_at_s < self._now_s() - _FORGET_AFTER_S))
            fresh = sa.select(_workers.c.executor).where(_workers.c.seen_at_s > self._now_s() - DEAD_AFTER_S)
            return set(connection.execute(fresh).scalars())

    def _now_s(self) -> sa.ColumnElement[float]:
        if self._database.engine.dialect.name == "sqlite":  # days since noon of a day long ago
            return (sa.func.julianday("now", type_=sa.Double) - 2440587.5) * 86400.0
        return sa.cast(sa.func.extract("epoch", sa.func.clock_timestamp()), sa.Double)

    def _run(self) -> None:
        beats = 0
        is_away = False
        while not self._stop.wait(BEAT_INTERVAL_S):
            try:
                self.beat()
                beats += 1
                if is_away:
                    _log.warning("the heartbeat is back")
                    is_away = False
                if beats % _LOOK_EVERY_BEATS == 0 and time.monotonic() > self._look_at_s:
                    self.take_over()
            except (UltragrayError, SQLAlchemyError) as error:
                if not is_away:
                    _log.warning(f"no heartbeat for now: {str(error).splitlines()[0]}")
                is_away = True
                self._look_at_s = time.monotonic() + DEAD_AFTER_S  # others may need longer to come back
