"""The workers of the queue: their signs of life, what administrators want of them, and how they see them.

Each worker beats every second, by the clock of the database, into its row of the table `workers`, and lets the jobs
wait again of those that have not beaten for a while. Free of torch.
"""

from __future__ import annotations

import logging
import os
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from enum import Enum

import sqlalchemy as sa
from sqlalchemy.exc import SQLAlchemyError

import ultragray
from ultragray.contract import described
from ultragray.errors import UltragrayError
from ultragray_workers.errors import WorkerNotFound, known_names
from ultragray_workers.jobs import queue
from ultragray_workers.jobs.demand import NO_OFFER, LivingWorker, Offer, WorkerDevice, offer_of_json
from ultragray_workers.jobs.tables import WORKERS, read, write
from ultragray_workers.rounds import Rounds

BEAT_INTERVAL_S = 1.0
_LOOK_EVERY_BEATS = 2
_FORGET_AFTER_S = 86_400.0

_log = logging.getLogger("ultragray.jobs")


class Wanted(str, Enum):
    """A wish for a worker, which holds until another one, restarts of the worker included."""

    WORK = "work"  # it takes jobs
    PAUSE = "pause"  # it takes none, and ends the job at hand
    DRAIN = "drain"  # it takes none; a training at hand goes back into the queue at once, other jobs are ended


class WorkerState(str, Enum):
    """The state of a worker."""

    IDLE = "idle"
    WORKING = "working"
    PAUSING = "pausing"
    PAUSED = "paused"
    DRAINING = "draining"
    DRAINED = "drained"
    LOST = "lost"


_STATES = {  # by what is wanted, and whether there is a job at hand
    (Wanted.WORK, False): WorkerState.IDLE,
    (Wanted.WORK, True): WorkerState.WORKING,
    (Wanted.PAUSE, False): WorkerState.PAUSED,
    (Wanted.PAUSE, True): WorkerState.PAUSING,
    (Wanted.DRAIN, False): WorkerState.DRAINED,
    (Wanted.DRAIN, True): WorkerState.DRAINING,
}


@dataclass(frozen=True, kw_only=True)
class Worker:
    """A worker of the queue."""

    name: str
    state: WorkerState = described("lost: it has given no sign of life for 10 s, or was stopped while paused.")
    host: str
    pid: int
    device: str = described("As it was started with: auto, cpu, cuda or cuda:N.")
    devices: tuple[WorkerDevice, ...] = described("Those that it does jobs on, the preferred one first.")
    labels: dict[str, str] = described("Those that jobs can ask for.")
    version: str = described("Of its release.")
    started_at: str | None = described("ISO 8601, UTC.")
    seconds_since_beat: float | None = described("Since its last sign of life; null: it was stopped.")
    job: str | None = described("The job at hand; null: none, or one that is private to somebody else.")


def list_workers(engine: sa.Engine) -> list[Worker]:
    """The workers that live, are wanted to rest, or were lost within a day, by name."""
    age_s = queue.now_s(engine) - WORKERS.c.seen_at_s
    rows = read(engine, sa.select(WORKERS, age_s.label("age_s")).order_by(WORKERS.c.name))
    return [_worker_of(row) for row in rows]


def living_workers(engine: sa.Engine) -> list[LivingWorker]:
    is_alive = WORKERS.c.seen_at_s > queue.now_s(engine) - queue.DEAD_AFTER_S
    statement = sa.select(WORKERS.c.name, WORKERS.c.offer, WORKERS.c.wanted).where(is_alive).order_by(WORKERS.c.name)
    return [
        LivingWorker(row.name, offer_of_json(row.offer), _wanted_of(row.wanted) is not Wanted.WORK)
        for row in read(engine, statement)
    ]


def want(engine: sa.Engine, name: str, wanted: Wanted) -> Worker:
    """Tells a worker what is wanted of it, which it does within a second or two. Raises WorkerNotFound."""
    value = None if wanted is Wanted.WORK else wanted.value
    write(engine, sa.update(WORKERS).where(WORKERS.c.name == name).values(wanted=value))
    workers = {worker.name: worker for worker in list_workers(engine)}
    if name not in workers:
        known = known_names("worker", list(workers))
        raise WorkerNotFound(f"there is no worker {name[:128]!r}; {known}", field="worker")
    return workers[name]


class Heartbeat:
    """The life sign of one worker, and its watch over the others."""

    def __init__(
        self,
        engine: sa.Engine,
        worker: str,
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
        self._engine, self._worker = engine, worker
        self._job_at_hand, self._is_stuck, self._obey = job_at_hand, is_stuck, obey
        self._facts = {
            "host": socket.gethostname(),
            "pid": os.getpid(),
            "device": device,
            "offer": offer.to_json(),
            "version": ultragray.__version__,
            "started_at_s": time.time(),
        }
        self._look_at_s = float("-inf")
        self._beats = 0
        self._is_away = False
        self._stop = threading.Event()
        self.beat()
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)
        self._thread.start()

    def beat(self) -> None:
        with self._engine.begin() as connection:
            mine = WORKERS.c.name == self._worker
            facts = {**self._facts, "seen_at_s": queue.now_s(self._engine), "job": self._job_at_hand()}
            if not connection.execute(sa.update(WORKERS).where(mine).values(facts)).rowcount:
                connection.execute(sa.insert(WORKERS).values(name=self._worker, **facts))
            wanted = connection.execute(sa.select(WORKERS.c.wanted).where(mine)).scalar()
        self._obey(_wanted_of(wanted))

    def take_over(self) -> list[str]:
        """Lets the jobs wait again that no living worker runs, and forgets workers of long ago; the ids of the jobs."""
        lost = queue.put_back_of_dead(self._engine)
        for job_id in lost:
            _log.warning(f"no worker is at the job {job_id} any more: it waits again")
        long_ago = WORKERS.c.seen_at_s < queue.now_s(self._engine) - _FORGET_AFTER_S, WORKERS.c.wanted.is_(None)
        if read(self._engine, sa.select(WORKERS.c.name).where(*long_ago).limit(1)):  # a look locks nothing
            write(self._engine, sa.delete(WORKERS).where(*long_ago))
        return lost

    def stop(self) -> None:
        """Ends the beats: from now on the others take the worker for gone."""
        self._stop.set()
        self._thread.join()
        with suppress(UltragrayError, SQLAlchemyError), self._engine.begin() as connection:
            mine = WORKERS.c.name == self._worker
            connection.execute(sa.update(WORKERS).where(mine).values(seen_at_s=0.0, job=None))
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
            self._look_at_s = time.monotonic() + queue.DEAD_AFTER_S  # others may need longer to come back


def _wanted_of(value: str | None) -> Wanted:
    return Wanted.WORK if value is None else Wanted(value)


def _worker_of(row: sa.Row[tuple[object, ...]]) -> Worker:
    facts = row._mapping
    is_lost = facts["age_s"] > queue.DEAD_AFTER_S
    offer = offer_of_json(facts["offer"])
    started_at_s = facts["started_at_s"]
    return Worker(
        name=facts["name"],
        state=WorkerState.LOST if is_lost else _STATES[_wanted_of(facts["wanted"]), facts["job"] is not None],
        host=facts["host"] or "",
        pid=facts["pid"] or 0,
        device=facts["device"] or "",
        devices=offer.devices,
        labels=dict(offer.labels),
        version=facts["version"] or "",
        started_at=None
        if started_at_s is None
        else datetime.fromtimestamp(started_at_s, timezone.utc).isoformat(timespec="seconds"),
        seconds_since_beat=max(0.0, round(facts["age_s"], 1)) if facts["seen_at_s"] else None,
        job=None if is_lost else facts["job"],
    )
