"""Limits of what the owners of jobs, datasets and scenes have, on all services of the database together."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime, time, timedelta, timezone

from ultragray.errors import UltragrayError
from ultragray_service.access.limits.allowance import GB
from ultragray_service.access.limits.limits import Limits
from ultragray_service.access.owners import Owners
from ultragray_service.access.principal import acting
from ultragray_service.core.jobs.jobs import Jobs
from ultragray_service.errors import LimitReached
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.errors import UploadTooLarge
from ultragray_workers.jobs.files import Artifact
from ultragray_workers.jobs.queue.owners import Kind
from ultragray_workers.jobs.shared.reading import SharedFile
from ultragray_workers.jobs.store import JobStore
from ultragray_workers.scenes import SceneStore


class Room:
    """The bytes that an upload may still store, of those that its key may."""

    def __init__(self, limits: Limits, left_bytes: int | None) -> None:
        self._limits, self._left_bytes = limits, left_bytes

    def at_most(self, max_bytes: int) -> int:
        """The largest upload, where any may have `max_bytes`."""
        return max_bytes if self._left_bytes is None else min(max_bytes, self._left_bytes)

    @contextmanager
    def to_blame(self, max_bytes: int) -> Iterator[None]:
        """Raises LimitReached where the body finds an upload too large that other keys might store."""
        try:
            yield
        except UploadTooLarge:
            if self.at_most(max_bytes) == max_bytes:
                raise
            raise self._limits.refused("stored_gb", _too_many_bytes(self._limits.mine.stored_gb)) from None


class Holdings:
    """What whoever the running code works for has, and whether there may be more."""

    def __init__(self, limits: Limits, owners: Owners, datasets: DatasetStore, scenes: SceneStore, jobs: Jobs) -> None:
        self._limits, self._owners = limits, owners
        self._datasets, self._scenes, self._jobs = datasets, scenes, jobs

    def admit_job(self, jobs: JobStore) -> int | None:
        """How many jobs may run at once; None: any number. Blocks. Raises LimitReached where there may be no more."""
        mine, owner = self._limits.mine, acting().name
        if mine.unfinished_jobs is not None and jobs.unfinished_of(owner) >= mine.unfinished_jobs:
            raise self._limits.refused(
                "unfinished_jobs",
                LimitReached(
                    f"{mine.unfinished_jobs} jobs of this key may wait or run (unfinished_jobs): wait for one to end, "
                    "or cancel one"
                ),
            )
        if mine.compute_minutes_per_day is not None:
            now = datetime.now(timezone.utc)
            if sum(jobs.usage_s(owner, now).values()) >= 60.0 * mine.compute_minutes_per_day:
                raise self._limits.refused(
                    "compute_minutes_per_day",
                    LimitReached(
                        f"the jobs of this key have run for the {mine.compute_minutes_per_day:g} minutes of a day "
                        "(compute_minutes_per_day): submit again after midnight (UTC)",
                        retry_after_s=(_next_day(now) - now).total_seconds() + 1.0,
                    ),
                )
        self._left_bytes(jobs)
        return mine.running_jobs

    async def room(self) -> Room:
        """The room for an upload. Raises LimitReached where there is none."""
        if self._limits.mine.stored_gb is None:
            return Room(self._limits, None)
        return Room(self._limits, await self._jobs.do(self._left_bytes))

    def _left_bytes(self, jobs: JobStore) -> int | None:
        """The bytes that there may still be; None: any number. Raises LimitReached where there may be none."""
        limit_gb, owner = self._limits.mine.stored_gb, acting().name
        if limit_gb is None:
            return None
        left_bytes = int(limit_gb * GB) - self._stored_bytes(jobs, owner)
        if left_bytes <= 0:
            raise self._limits.refused("stored_gb", _too_many_bytes(limit_gb))
        return left_bytes

    def _stored_bytes(self, jobs: JobStore, owner: str) -> int:
        dataset_bytes = 0
        for name in self._owners.owned(Kind.DATASET, owner):
            with suppress(UltragrayError):  # a damaged one, or one that has just gone
                dataset_bytes += self._datasets.get(name).bytes
        names = self._owners.owned(Kind.SCENE, owner)
        scenes = [path for name in names if (path := self._scenes.file(name)) is not None]
        dataset_bytes += sum(self._scenes.bytes_in_buckets(name) for name in names)
        return dataset_bytes + _bytes_of([*scenes, *jobs.artifact_files_of(owner)])


def _bytes_of(files: Iterable[Artifact]) -> int:
    """Of the files that are there; one of several names counts once, such as a scene and the artifact that it was."""
    sizes: dict[object, int] = {}
    for file in files:
        if isinstance(file, SharedFile):
            sizes[file.stored.key] = file.stored.bytes
            continue
        with suppress(OSError):
            status = os.stat(file)
            sizes[status.st_dev, status.st_ino] = status.st_size
    return sum(sizes.values())


def _too_many_bytes(limit_gb: float | None) -> LimitReached:
    return LimitReached(
        f"this key may store {limit_gb:g} GB (stored_gb) in datasets, scenes and artifacts of jobs: delete some first"
    )


def _next_day(now: datetime) -> datetime:
    return datetime.combine(now.date() + timedelta(days=1), time(), timezone.utc)
