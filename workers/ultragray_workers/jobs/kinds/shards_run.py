"""The work of a render job in shards, and of the shares that help it. Interrupted, it goes on with what is missing.

The job that was submitted is the batch: it lays out a row for each shard, works at them itself, and writes the manifest
when all are done. While shards are free, one *share* of the batch waits in the queue, a task that users do not see: the
worker that takes it puts the next one behind it, and works at the shards, too. So all workers that have nothing else to
do come to help, one at a time, and each keeps the scene loaded between shards. Which shard is whose stands in a table,
which the processes of the batch and of its shares ask themselves: of one that dies, only what it had at hand is
rendered again.
"""

from __future__ import annotations

import gc
import os
import sys
import time
import uuid
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event
from typing import Any, NamedTuple, TypeVar

import sqlalchemy as sa
from sqlalchemy.exc import OperationalError

from ultragray.errors import UltragrayError
from ultragray.exchange.batches import MANIFEST_FILE, BatchPlan, ShardEntry
from ultragray.exchange.shards import ShardRenderer
from ultragray.files import file_sha256
from ultragray.learn.training.memory import training_device
from ultragray.rendering.limits import Limits
from ultragray.scene.info import read_header
from ultragray_workers.batches.place import ShardPlace
from ultragray_workers.errors import DatabaseUnavailable, StartupFailed, StorageFull, StorageUnavailable
from ultragray_workers.jobs import queue
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.files import batch_prefix
from ultragray_workers.jobs.kinds.render import RenderJob
from ultragray_workers.jobs.progress import JobState, Outcome, Progress
from ultragray_workers.jobs.tables import JOBS, SHARDS, insert, read
from ultragray_workers.jobs.worker.job_run import JobRun, Stopped
from ultragray_workers.jobs.worker.process import DATABASE_VARIABLE
from ultragray_workers.scene_names import SUFFIX
from ultragray_workers.storage.location import open_storage

MOST_TRIES = 20  # of one shard: after so many deaths of those who were at it, it is to blame
_PATIENCE_S = 600.0  # of a small request to the storage
_LOOK_EVERY_S, _POLL_S = 1.0, 0.2
_ASK_AGAIN_S = 0.5  # while others are at the last shards
_AWAY = (DatabaseUnavailable, StartupFailed, StorageFull, OperationalError, StorageUnavailable)
_ROWS = SHARDS.c
_T = TypeVar("_T")


def run(job_run: JobRun, job: RenderJob) -> Outcome:
    """Makes shards until all are there; the job itself, unlike its shares, then writes the manifest.

    Raises Stopped, what `BatchPlan.prepared` and `ShardRenderer` raise, and OSError.
    """
    request = job_run.request
    batch, is_batch = request.batch or job_run.folder.job_id, request.batch is None
    storage = open_storage(request.storage, patience_s=_PATIENCE_S)
    scene_file = job_run.folder.path / f"{job.scene}{SUFFIX}"
    plan = job.plan(read_header(scene_file), file_sha256(scene_file))
    place = ShardPlace(storage, batch_prefix(batch), plan)
    if is_batch and place.is_finished():  # by a process that died before it said so
        return _complete(job_run, plan)
    try:
        with job_run.folder.scratch() as scratch, ShardQueue(job_run, place) as shards:
            if is_batch:
                if request.retry_of is not None and not place.whole():
                    place.take_over(ShardPlace(storage, batch_prefix(request.retry_of), plan))
                shards.lay_out(plan, done := place.whole())
                there = f"{plan.shard_count:,} shards, {len(done):,} of them are there"
                sys.stderr.write(f"{plan.frames:,} frames in {there}\n")
            _make_shards(job_run, shards, place, scene_file, scratch)
    except BatchFailed as error:
        return Outcome(error=error.error, reason=error.reason)
    if not is_batch:
        return Outcome()
    place.finish()
    return _complete(job_run, plan)


def _complete(job_run: JobRun, plan: BatchPlan) -> Outcome:
    job_run.report(Progress(frames_done=plan.frames, frames=plan.frames, seconds_left=0.0))
    return Outcome(artifacts=(MANIFEST_FILE, plan.file_names))


def _make_shards(job_run: JobRun, shards: ShardQueue, place: ShardPlace, scene_file: Path, scratch: Path) -> None:
    renderer: ShardRenderer | None = None
    while (shard := shards.take()) is not None:
        if place.entry(shard) is not None:  # made by a process that died before it said so
            shards.complete(shard)
            continue
        if renderer is None:
            limits = Limits(job_run.request.max_footprint_pixels, name_pose="frame {}".format)
            device = training_device(job_run.request.device, "auto")
            renderer = ShardRenderer(place.plan, scene_file, device, limits=limits)
            gc.freeze()  # the libraries' objects: to look through them takes as long as twenty frames
            sys.stderr.write(f"rendering shards of {job_run.folder.job_id} on {device}\n")
        path = scratch / place.plan.file_name(shard)
        with _blamed(place.plan, shard):
            entry = renderer.render(shard, path, shards.report)
        shards.keep(path, shard, entry)
    shards.wait_until_kept()


@contextmanager
def _blamed(plan: BatchPlan, shard: int) -> Iterator[None]:
    """Errors from inside say which shard they are about."""
    try:
        yield
    except UltragrayError as error:
        frames = plan.frames_of(shard)
        about = f"{error.field}: " if error.field is not None and error.field not in error.detail else ""
        raise type(error)(
            f"shard {shard} (frames {frames.start:,} to {frames.stop - 1:,}): {about}{error.detail}"
        ) from error


class BatchFailed(Exception):
    """A shard cannot be made, by whomever it was tried: the stable reason of the error, and one sentence."""

    def __init__(self, error: str, reason: str) -> None:
        super().__init__(reason)
        self.error, self.reason = error, reason


class ShardQueue:
    """The shards that the process of a batch makes, or of a share of it, during the body.

    Threads ask the database, for the next shard ahead, so that rendering never waits for it.
    """

    def __init__(self, job_run: JobRun, place: ShardPlace) -> None:
        """Raises Stopped where the worker stops while the database is away."""
        request, folder = job_run.request, job_run.folder
        self._share, self._batch = folder.job_id, request.batch or folder.job_id
        self._is_batch = request.batch is None
        self._leaves_at_s = time.monotonic() + request.longest_share_s
        self._job_run, self._is_left = job_run, Event()
        self._place = place
        self._threads = ThreadPoolExecutor(3, "shards")
        self._keeping: Future[None] | None = None
        self._ahead: Future[int | None] | None = None
        self._looking: Future[None] | None = None
        self._looked_at_s = float("-inf")
        self._of_batch: int | None = None  # frames that are done; None: not known yet
        self._own_frames = self._furthest = 0  # frames
        self._since: tuple[float, int] | None = None  # a time, and the frames that were done then
        url = os.environ[DATABASE_VARIABLE]
        self._database = self._patiently(lambda: JobDatabase(folder.artifact_folder, url, place.storage))
        mine = sa.and_(_ROWS.job == self._batch, _ROWS.share == self._share)  # of a process that died
        self._change(sa.update(SHARDS).where(mine).values(share=None))

    def __enter__(self) -> ShardQueue:
        return self

    def __exit__(self, *exception: object) -> None:
        self._is_left.set()
        self._threads.shutdown()
        self._database.close()

    def lay_out(self, plan: BatchPlan, done: Collection[int]) -> None:
        """Makes the rows of the batch, those that are `done` already included. Raises Stopped."""
        whole = set(done)
        rows = [
            {"job": self._batch, "number": number, "frames": len(plan.frames_of(number)), "done": number in whole}
            for number in range(plan.shard_count)
        ]
        self._change(insert(self._database.engine, SHARDS).values(tries=0).on_conflict_do_nothing(), rows)

    def take(self) -> int | None:
        """The next shard; None where this process is not needed any more. Raises BatchFailed, Stopped."""
        future = self._ahead or self._threads.submit(self._take)
        while not future.done():
            self.report()
            wait([future], _POLL_S)
        shard = future.result()
        self._ahead = None if shard is None else self._threads.submit(self._take)
        return shard

    def keep(self, path: Path, shard: int, entry: ShardEntry) -> None:
        """Lets a thread put a shard in its place, beside the rendering of the next one: at most one waits."""
        self.wait_until_kept()
        self._keeping = self._threads.submit(self._keep, path, shard, entry)
        self._own_frames += entry.frames

    def wait_until_kept(self) -> None:
        if self._keeping is not None:
            self._keeping.result()

    def _keep(self, path: Path, shard: int, entry: ShardEntry) -> None:
        self._patiently(lambda: self._place.keep(path, shard, entry))
        path.unlink()
        self.complete(shard)

    def complete(self, shard: int) -> None:
        """Says that a shard is in its place. Raises Stopped."""
        statement = sa.update(SHARDS).where(_ROWS.job == self._batch, _ROWS.number == shard)
        self._change(statement.values(done=True, share=None, error=None, reason=None))

    def report(self, done: int = 0) -> None:
        """Reports how far the batch is, or what its share has made; `done`: frames of the shard at hand.

        Once a second a thread counts the frames of the batch, and calls for help where shards are free. Raises
        Stopped.
        """
        if self._job_run.should_stop():
            raise Stopped
        now_s = time.monotonic()
        if now_s - self._looked_at_s >= _LOOK_EVERY_S and (self._looking is None or self._looking.done()):
            if self._looking is not None:
                self._looking.result()
            self._looked_at_s, self._looking = now_s, self._threads.submit(self._look)
        before_it = self._of_batch if self._is_batch else self._own_frames
        if before_it is None:
            return
        frames, total = self._place.plan.frames, max(self._furthest, done + before_it)
        self._furthest = total
        since_s, before = self._since = self._since or (now_s, total)
        rate = (total - before) / (now_s - since_s) if total > before else None
        left_s = None if rate is None else (frames - total) / rate
        self._job_run.report(Progress(frames_done=total, frames=frames, rate_per_s=rate, seconds_left=left_s))

    def _look(self) -> None:
        with suppress(*_AWAY):
            counted = self._tally()
            self._of_batch = counted.frames_done
            if counted.free:
                queue.add_share(self._database.engine, self._batch, f"{self._batch}-{uuid.uuid4().hex[:8]}")

    def _take(self) -> int | None:
        while True:
            shard, is_over = self._patiently(self._next)
            if shard is not None or is_over:
                return shard
            if self._is_left.wait(_ASK_AGAIN_S) or self._job_run.should_stop():
                raise Stopped

    def _next(self) -> tuple[int | None, bool]:
        """The next shard that is free, and whether there will be none any more for this process."""
        self._raise_failure()
        has_worked = time.monotonic() > self._leaves_at_s
        if not self._is_batch and has_worked and queue.count_waiting(self._database.engine):
            return None, True  # other jobs have their turn: the next share waits behind them
        shard = self._take_free()
        if shard is None and self._is_batch:
            self._free_lost()
            shard = self._take_free()
        if shard is not None:
            return shard, False
        counted = self._tally()
        return None, not self._is_batch or counted.done == counted.shards

    def _raise_failure(self) -> None:
        """Raises BatchFailed for the first shard that cannot be made, where there is one."""
        is_lost = sa.and_(_ROWS.share.is_(None), _ROWS.tries >= MOST_TRIES)
        query = (
            sa.select(_ROWS.error, _ROWS.reason)
            .where(_ROWS.job == self._batch, ~_ROWS.done, sa.or_(_ROWS.error.is_not(None), is_lost))
            .order_by(_ROWS.number)
            .limit(1)
        )
        for row in read(self._database.engine, query):
            why = row.reason or f"its process or worker died {MOST_TRIES} times"
            raise BatchFailed(row.error or "INTERNAL", why)

    def _take_free(self) -> int | None:
        others = SHARDS.alias()
        free = (
            sa.select(others.c.number)
            .where(others.c.job == self._batch, *_is_free(others.c))
            .order_by(others.c.number)
            .limit(1)
            .with_for_update(skip_locked=True)
        )
        # One statement: a SQLite file is locked from a change on, not from the question before it.
        taking = (
            sa.update(SHARDS)
            .where(_ROWS.job == self._batch, _ROWS.number == free.scalar_subquery(), _ROWS.share.is_(None))
            .values(share=self._share, tries=_ROWS.tries + 1)
            .returning(_ROWS.number)
        )
        with self._database.engine.begin() as connection:
            return connection.execute(taking).scalar()

    def _free_lost(self) -> None:
        """Frees the shards of shares that nobody runs any more."""
        running = sa.select(JOBS.c.id).where(JOBS.c.id == _ROWS.share, JOBS.c.state == JobState.RUNNING.value)
        lost = sa.and_(_ROWS.job == self._batch, _ROWS.share.is_not(None), ~running.exists())
        self._change(sa.update(SHARDS).where(lost).values(share=None))

    def _tally(self) -> _Tally:
        done = sa.case((_ROWS.done, 1), else_=0)
        free = sa.case((sa.and_(*_is_free(_ROWS)), 1), else_=0)
        counted = sa.select(
            sa.func.count(), *(sa.func.coalesce(sa.func.sum(one), 0) for one in (free, done, done * _ROWS.frames))
        ).where(_ROWS.job == self._batch)
        (row,) = read(self._database.engine, counted)
        return _Tally(*map(int, row))

    def _change(self, statement: sa.Executable, rows: Sequence[dict[str, Any]] | None = None) -> None:
        def change() -> None:
            with self._database.engine.begin() as connection:
                connection.execute(statement, rows)

        self._patiently(change)

    def _patiently(self, work: Callable[[], _T]) -> _T:
        def unless_left() -> _T:
            if self._is_left.is_set():
                raise Stopped
            return work()

        return self._job_run.patiently(unless_left, *_AWAY)


class _Tally(NamedTuple):
    """The shards of a batch, how many of them are free and done, and the frames of the latter."""

    shards: int
    free: int  # nobody is at them
    done: int
    frames_done: int


def _is_free(row: Any) -> tuple[sa.ColumnElement[bool], ...]:
    return ~row.done, row.share.is_(None), row.error.is_(None), row.tries < MOST_TRIES
