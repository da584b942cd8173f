"""The work of a render job in shards, and of the shares that help it. Interrupted, it goes on with what is missing."""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from ultragray.errors import UltragrayError
from ultragray.exchange.batches import MANIFEST_FILE, BatchPlan, ShardEntry
from ultragray.exchange.shards import ShardRenderer
from ultragray.files import file_sha256
from ultragray.learn.training.memory import training_device
from ultragray.rendering.limits import Limits
from ultragray.scene.info import read_header
from ultragray_workers.batches.place import ShardPlace
from ultragray_workers.errors import StorageUnavailable
from ultragray_workers.jobs.files import batch_prefix
from ultragray_workers.jobs.kinds.render import RenderJob
from ultragray_workers.jobs.progress import Outcome, Progress
from ultragray_workers.jobs.shards import BatchFailed, ShardQueue
from ultragray_workers.jobs.worker.job_run import JobRun, Stopped
from ultragray_workers.scene_names import SUFFIX
from ultragray_workers.storage.location import open_storage

_RETRY_S = 2.0  # while the storage is away
_PATIENCE_S = 600.0  # of a small request to it


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
        with ShardQueue(job_run, storage) as queue:
            if is_batch:
                if request.retry_of is not None and not place.whole():
                    place.take_over(ShardPlace(storage, batch_prefix(request.retry_of), plan))
                queue.lay_out(plan.frames, plan.shard_frames, done := place.whole())
                there = f"{plan.shard_count:,} shards, {len(done):,} of them are there"
                sys.stderr.write(f"{plan.frames:,} frames in {there}\n")
            _make_shards(job_run, queue, place, scene_file)
    except BatchFailed as error:
        return Outcome(error=error.error, reason=error.reason)
    if not is_batch:
        return Outcome()
    place.finish()
    return _complete(job_run, plan)


def _complete(job_run: JobRun, plan: BatchPlan) -> Outcome:
    job_run.report(Progress(frames_done=plan.frames, frames=plan.frames, seconds_left=0.0))
    return Outcome(artifacts=(MANIFEST_FILE, plan.file_names))


def _make_shards(job_run: JobRun, queue: ShardQueue, place: ShardPlace, scene_file: Path) -> None:
    renderer: ShardRenderer | None = None
    meter = _Meter(job_run, queue, place.plan)
    with job_run.folder.scratch() as folder, _Keeper(job_run, queue, place) as keeper:
        while (shard := queue.take(meter.look)) is not None:
            if place.entry(shard) is not None:  # made by a process that died before it said so
                queue.done(shard)
                continue
            if renderer is None:
                limits = Limits(job_run.request.max_footprint_pixels, name_pose="frame {}".format)
                device = training_device(job_run.request.device, "auto")
                renderer = ShardRenderer(place.plan, scene_file, device, limits=limits)
                gc.freeze()  # the libraries' objects: to look through them takes as long as twenty frames
                sys.stderr.write(f"rendering shards of {job_run.folder.job_id} on {device}\n")
            path = folder / place.plan.file_name(shard)
            with _blamed(place.plan, shard):
                entry = renderer.render(shard, path, meter.before_portion)
            keeper.keep(path, shard, entry)
            meter.finished(entry.frames)
        keeper.wait()


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


class _Keeper:
    """Puts shards into their place beside the rendering of the next one: at most one waits."""

    def __init__(self, job_run: JobRun, queue: ShardQueue, place: ShardPlace) -> None:
        self._job_run, self._queue, self._place = job_run, queue, place
        self._thread = ThreadPoolExecutor(1, "keeper")
        self._last: Future[None] | None = None
        self._is_given_up = False

    def __enter__(self) -> _Keeper:
        return self

    def __exit__(self, kind: object, *exception: object) -> None:
        self._is_given_up = kind is not None
        self._thread.shutdown()

    def keep(self, path: Path, shard: int, entry: ShardEntry) -> None:
        self.wait()
        self._last = self._thread.submit(self._keep, path, shard, entry)

    def wait(self) -> None:
        if self._last is not None:
            self._last.result()
            self._last = None

    def _keep(self, path: Path, shard: int, entry: ShardEntry) -> None:
        while True:
            try:
                self._place.keep(path, shard, entry)
                break
            except StorageUnavailable as error:
                sys.stderr.write(f"waiting with {entry.file}: {error.detail}\n")
            if self._is_given_up or self._job_run.should_stop():
                raise Stopped
            time.sleep(_RETRY_S)
        path.unlink()
        self._queue.done(shard)


class _Meter:
    """The progress of the job: of the batch in its own process, of what it made itself in that of a share."""

    def __init__(self, job_run: JobRun, queue: ShardQueue, plan: BatchPlan) -> None:
        self._job_run, self._queue = job_run, queue
        self._is_batch = job_run.request.batch is None
        self._frames = plan.frames
        self._finished = self._furthest = 0
        self._since: tuple[float, int] | None = None  # a time, and the frames that were done then

    def finished(self, frames: int) -> None:
        self._finished += frames

    def look(self) -> None:
        """Tells how far others are. Raises Stopped, BatchFailed."""
        self.before_portion(0)

    def before_portion(self, done: int) -> None:
        """Tells that so many frames of the shard at hand are done. Raises Stopped, BatchFailed."""
        if self._job_run.should_stop():
            raise Stopped
        self._queue.look()
        before_it = self._queue.frames_done if self._is_batch else self._finished
        if before_it is None:
            return
        total = self._furthest = max(self._furthest, done + before_it)
        now_s = time.monotonic()
        since_s, before = self._since = self._since or (now_s, total)
        rate = (total - before) / (now_s - since_s) if total > before else None
        left_s = None if rate is None else (self._frames - total) / rate
        self._job_run.report(Progress(frames_done=total, frames=self._frames, rate_per_s=rate, seconds_left=left_s))
