"""The workers that are alive: a small table beside the queue, and the take-over of the jobs of those that are not.

DBOS hands a dead worker's jobs to nobody. Here each worker beats every second, by the clock of the database, and puts
the jobs of workers that have not beaten for a while back into the queue. It does the same with jobs of its own that it
does not run: DBOS forgets a job whose end it cannot write, such as on a full disk.
"""

from __future__ import annotations

import logging
import os
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress

import sqlalchemy as sa
from sqlalchemy.exc import SQLAlchemyError

import ultragray
from ultragray.errors import UltragrayError
from ultragray_workers.jobs.matching.offer import NO_OFFER, Offer
from ultragray_workers.jobs.queue import unfinished
from ultragray_workers.jobs.queue.database import JobDatabase
from ultragray_workers.jobs.queue.tables import WORKERS
from ultragray_workers.jobs.queue.wishes import Wanted, wanted_of
from ultragray_workers.rounds import Rounds

BEAT_INTERVAL_S = 1.0
DEAD_AFTER_S = 10.0
_LOOK_EVERY_BEATS = 2
_FORGET_AFTER_S = 86_400.0

_log = logging.getLogger("ultragray.jobs")


class Heartbeat:
    """The life sign of one worker, and its watch over the others."""

    def __init__(
        self,
        jobs: JobDatabase,
        executor: str,
        job_at_hand: Callable[[], str | None],
        is_stuck: Callable[[], bool] = lambda: False,
        *,
        device: str = "",
        offer: Offer = NO_OFFER,
        obey: Callable[[Wanted], None] = lambda wanted: None,
    ) -> None:
        """The first beat is done when this returns. While the worker `is_stuck`, there are none.

        `obey` is called after each beat with what administrators want of the worker.
        """
        self._database, self._executor = jobs, executor
        self._job_at_hand, self._is_stuck, self._obey = job_at_hand, is_stuck, obey
        self._facts = {
            "host": socket.gethostname(),
            "pid": os.getpid(),
            "device": device,
            "offer": offer.to_json(),
            "version": ultragray.__version__,
            "started_at_s": time.time(),
        }
        self._forgotten: set[str] = set()  # own jobs that were not running at the last look
        self._look_at_s = float("-inf")
        self._beats = 0
        self._is_away = False
        self._stop = threading.Event()
        self.beat()
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)
        self._thread.start()

    def beat(self) -> None:
        """Writes that the worker is alive."""
        with self._database.engine.begin() as connection:
            mine = WORKERS.c.executor == self._executor
            facts = {**self._facts, "seen_at_s": now_s(self._database), "job_id": self._job_at_hand()}
            if not connection.execute(sa.update(WORKERS).where(mine).values(facts)).rowcount:
                connection.execute(sa.insert(WORKERS).values(executor=self._executor, **facts))
            wanted = connection.execute(sa.select(WORKERS.c.wanted).where(mine)).scalar()
        self._obey(wanted_of(wanted))

    def take_over(self) -> list[str]:
        """Puts the jobs that no living worker runs back into the queue, and returns their ids."""
        running = unfinished.running(self._database)
        mine = {job_id for job_id, executor in running if executor == self._executor} - {self._job_at_hand()}
        twice, self._forgotten = mine & self._forgotten, mine
        if not running:
            return []
        living = alive(self._database) | {self._executor}
        taken = [
            job_id
            for job_id, executor in running
            if (executor not in living or job_id in twice) and self._database.put_back(job_id, executor)
        ]
        if taken:
            unfinished.adopt_older(self._database)
        for job_id in taken:
            _log.warning(f"no worker is at the job {job_id} any more: it waits again")
        return taken

    def stop(self) -> None:
        """Ends the beats: from now on the others take the worker for gone."""
        self._stop.set()
        self._thread.join()
        with suppress(UltragrayError, SQLAlchemyError), self._database.engine.begin() as connection:
            mine = WORKERS.c.executor == self._executor
            connection.execute(sa.update(WORKERS).where(mine).values(seen_at_s=0.0, job_id=None))
            connection.execute(sa.delete(WORKERS).where(mine, WORKERS.c.wanted.is_(None)))  # else it holds at a restart

    def _run(self) -> None:
        rounds = Rounds("the heartbeat", _log)
        while not self._stop.wait(BEAT_INTERVAL_S):
            with rounds.round():
                self._beat_and_look()

    def _beat_and_look(self) -> None:
        if self._is_stuck():
            if not self._is_away:
                _log.error(f"the job {self._job_at_hand()} is stuck, and so is its worker: others may take it over")
            self._is_away = True
            return
        try:
            self.beat()
            self._beats += 1
            if self._is_away:
                _log.warning("the heartbeat is back")
                self._is_away = False
            if self._beats % _LOOK_EVERY_BEATS == 0 and time.monotonic() > self._look_at_s:
                self.take_over()
        except (UltragrayError, SQLAlchemyError) as error:
            if not self._is_away:
                _log.warning(f"no heartbeat for now: {str(error).splitlines()[0]}")
            self._is_away = True
            self._look_at_s = time.monotonic() + DEAD_AFTER_S  # others may need longer to come back


def alive(jobs: JobDatabase) -> set[str]:
    """The workers that have beaten lately; those of long ago are forgotten."""
    with jobs.engine.begin() as connection:
        long_ago = WORKERS.c.seen_at_s < now_s(jobs) - _FORGET_AFTER_S
        connection.execute(sa.delete(WORKERS).where(long_ago, WORKERS.c.wanted.is_(None)))
        fresh = sa.select(WORKERS.c.executor).where(WORKERS.c.seen_at_s > now_s(jobs) - DEAD_AFTER_S)
        return set(connection.execute(fresh).scalars())


def now_s(jobs: JobDatabase) -> sa.ColumnElement[float]:
    """The time by the clock of the database, which all hosts share."""
    if jobs.engine.dialect.name == "sqlite":  # days since noon of a day long ago
        return (sa.func.julianday("now", type_=sa.Double) - 2440587.5) * 86400.0
    return sa.cast(sa.func.extract("epoch", sa.func.clock_timestamp()), sa.Double)
