"""Data sets and scenes that clients send, through any door: onto the disk as they come, then checked."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator, Awaitable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from contextvars import copy_context
from datetime import datetime, time, timedelta, timezone
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from ultragray.contract import from_dict
from ultragray.datasets.source import SourceOptions
from ultragray.errors import DatasetInvalid, SceneFileInvalid, UltragrayError
from ultragray.files import sync
from ultragray.scene.info import SceneHeader, read_header
from ultragray_service.access.audit import account
from ultragray_service.access.limits import Limits, Slots
from ultragray_service.access.owners import Claim, Owners
from ultragray_service.access.principals import GB, acting
from ultragray_service.core.jobs.jobs import Jobs
from ultragray_service.core.threads import HelperProcesses, in_own_thread, to_its_end
from ultragray_service.errors import LimitReached, SceneReadOnly
from ultragray_service.settings import Settings
from ultragray_workers.claims import storage_full
from ultragray_workers.datasets.intake import IncomingDataset, remove_stale, take_in
from ultragray_workers.datasets.store import DatasetRecord, DatasetStore, check_dataset_name
from ultragray_workers.errors import DeadlineExceeded, Draining, SceneExists, SceneNotFound, UploadTooLarge
from ultragray_workers.jobs.owners import Kind
from ultragray_workers.jobs.store import JobStore
from ultragray_workers.scene_names import SUFFIX, check_scene_name
from ultragray_workers.scene_shelf import SceneShelf
from ultragray_workers.scenes import SceneStore, check_scene_file

T = TypeVar("T")


async def arrival(arriving: Awaitable[T], idle_timeout_s: float, stopping: asyncio.Future[Any]) -> T:
    """The result of `arriving`.

    Raises DeadlineExceeded where it does not come in time, Draining once `stopping` is done.
    """
    work = asyncio.ensure_future(arriving)
    either: set[asyncio.Future[Any]] = {work, stopping}
    try:
        await asyncio.wait(either, timeout=idle_timeout_s, return_when=asyncio.FIRST_COMPLETED)
        if stopping.done():
            raise Draining("the service is stopping; send it again")
        if not work.done():
            raise DeadlineExceeded(f"the upload sent nothing for {idle_timeout_s:g} s")
        return work.result()
    finally:
        work.cancel()


# Limits of what the owners of jobs, datasets and scenes have, on all services of the database together.


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


class Quotas:
    """What whoever the running code works for has, and whether there may be more."""

    def __init__(self, limits: Limits, owners: Owners, datasets: DatasetStore, scenes: SceneStore) -> None:
        self._limits, self._owners = limits, owners
        self._datasets, self._scenes = datasets, scenes

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

    async def room(self, jobs: Jobs) -> Room:
        """The room for an upload. Raises LimitReached where there is none."""
        if self._limits.mine.stored_gb is None:
            return Room(self._limits, None)
        return Room(self._limits, await jobs.do(self._left_bytes))

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
        scenes = [self._scenes.stored(name) for name in self._owners.owned(Kind.SCENE, owner)]
        sizes = dict(filter(None, scenes))  # a scene and the artifact that it was are one content
        sizes |= {file.stored.sha256: file.stored.bytes for file in jobs.artifact_files_of(owner)}
        return dataset_bytes + sum(sizes.values())


def _too_many_bytes(limit_gb: float | None) -> LimitReached:
    return LimitReached(
        f"this key may store {limit_gb:g} GB (stored_gb) in datasets, scenes and artifacts of jobs: delete some first"
    )


def _next_day(now: datetime) -> datetime:
    return datetime.combine(now.date() + timedelta(days=1), time(), timezone.utc)


# Uploads of datasets, from either front door: to the disk as they come, then checked in a process of their own.


MAX_UPLOADS = 8
DATASET_CHECK_TIMEOUT_S = 1800.0
_BLOCK_BYTES = 1 << 20
_POLL_INTERVAL_S = 0.25

_log = logging.getLogger("ultragray.service")


class DatasetUploads:
    """The uploads under way. A few at a time are received, and wait for their turn in `checks`."""

    def __init__(
        self,
        store: DatasetStore,
        settings: Settings,
        jobs: Jobs,
        draining: asyncio.Event,
        checks: HelperProcesses,
        owners: Owners,
        quotas: Quotas,
    ) -> None:
        self._jobs = jobs
        self._store = store
        self._quotas = quotas
        self._owners = owners
        self._settings = settings
        self._draining = draining
        self._checks = checks
        self._slots = Slots(MAX_UPLOADS, "uploads of datasets")

    @asynccontextmanager
    async def receive(self, name: str, options: dict[str, str], *, private: bool) -> AsyncIterator[DatasetUpload]:
        """An upload; what has not become a dataset at the end is removed.

        Raises InvalidArgument for a bad name or option, QueueFull, LimitReached, Draining, StorageFull.
        """
        check_dataset_name(name)
        account().target = name
        from_dict(SourceOptions, options)
        if self._draining.is_set():
            raise Draining("the service is stopping")
        with self._slots.one():
            stopping: asyncio.Future[Any] = asyncio.ensure_future(self._draining.wait())
            try:
                room, most = await self._quotas.room(self._jobs), self._settings.max_dataset_bytes
                incoming = await asyncio.to_thread(IncomingDataset, self._store, room.at_most(most))
                claim = Claim(self._owners, Kind.DATASET, name, incoming.folder.name, private=private)
                upload = DatasetUpload(
                    incoming, name, options, self._settings, stopping, self._checks, claim, room.at_most(most)
                )
                try:
                    with room.to_blame(most):
                        yield upload
                finally:
                    await upload.ended()
                    await asyncio.shield(asyncio.to_thread(incoming.discard))
            finally:
                stopping.cancel()

    async def remove_stale(self) -> None:
        """Removes what uploads of dead services left."""
        if removed := await asyncio.to_thread(remove_stale, self._store):
            _log.info(f"removed {removed} uploads and deletions that were not finished")


class DatasetUpload:
    """One upload: files or an archive, a block at a time, then the check."""

    def __init__(
        self,
        incoming: IncomingDataset,
        name: str,
        options: dict[str, str],
        settings: Settings,
        stopping: asyncio.Future[Any],
        checks: HelperProcesses,
        claim: Claim,
        max_bytes: int,
    ) -> None:
        self._max_bytes = max_bytes
        self._incoming = incoming
        self._claim = claim
        self._name = name
        self._options = options
        self._settings = settings
        self._stopping = stopping
        self._checks = checks
        self._block = bytearray()
        self._finishing = asyncio.Lock()

    async def next(self, arriving: Awaitable[T]) -> T:
        """The next part of what the client sends.

        Raises DeadlineExceeded where it sends nothing for too long, Draining where the service stops.
        """
        return await arrival(arriving, self._settings.upload_idle_timeout_s, self._stopping)

    async def begin_file(self, name: str) -> None:
        """Begin the file `name`. Raises DatasetInvalid, UploadTooLarge, StorageFull."""
        await self._flush()
        await asyncio.to_thread(self._incoming.begin_file, name)

    async def begin_archive(self) -> None:
        """Begin the one archive. Raises StorageFull."""
        await asyncio.to_thread(self._incoming.begin_archive)

    async def write(self, data: bytes) -> None:
        """Raises UploadTooLarge, StorageFull, DatasetInvalid."""
        self._block += data
        if len(self._block) >= _BLOCK_BYTES:
            await self._flush()

    async def _flush(self) -> None:
        if self._block:
            block, self._block = bytes(self._block), bytearray()
            await asyncio.to_thread(self._incoming.write, block)

    async def finish(self) -> tuple[DatasetRecord, bool]:
        """Checks what was sent and makes it a dataset; its record, and whether it is new.

        Raises DatasetInvalid with the file and the frame, InvalidArgument for an option, DatasetExists, UploadTooLarge,
        MemoryExceeded, StorageFull, DeadlineExceeded.
        """
        async with self._finishing, self._claim.held():
            await self._flush()
            await asyncio.to_thread(self._incoming.finish)
            arguments = {
                "folder": str(self._incoming.folder),
                "name": self._name,
                "options": self._options,
                "max_bytes": self._max_bytes,
            }
            await self._take_name()
            await self._checks.run(
                take_in,
                arguments,
                what="checking the dataset",
                timeout_s=DATASET_CHECK_TIMEOUT_S,
                killed=DatasetInvalid,
            )
            while not await self._take_name():
                if await asyncio.to_thread(self._incoming.store.is_taken, self._name):
                    return await asyncio.to_thread(self._incoming.present, self._name), False
                await asyncio.sleep(_POLL_INTERVAL_S)  # another upload of the name is being checked
            await self._claim.spread()
            return await to_its_end(partial(copy_context().run, self._accept))

    async def _take_name(self) -> bool:
        """Whether the name is now this upload's; it is not where there is a dataset, whoever has it."""
        if await asyncio.to_thread(self._incoming.store.is_taken, self._name):
            return False
        return await self._claim.take(lambda claim: asyncio.to_thread(self._incoming.is_there, self._name, claim))

    def _accept(self) -> tuple[DatasetRecord, bool]:
        record, self._claim.is_made = self._incoming.accept(self._name)
        return record, self._claim.is_made

    async def ended(self) -> None:
        """Returns when a `finish` that was cancelled has ended its process."""
        async with self._finishing:
            pass


# Scenes that clients send and delete: they lie beside those that jobs make.


SCENE_CHECK_TIMEOUT_S = 600.0
MAX_IMPORTS = 4


class SceneImports:
    """Takes scene files in, whole or not at all, and removes them."""

    def __init__(
        self,
        store: SceneStore,
        shelf: SceneShelf,
        settings: Settings,
        jobs: Jobs,
        checks: HelperProcesses,
        owners: Owners,
        quotas: Quotas,
    ) -> None:
        """`shelf`: of the store, for what is imported."""
        self._store = store
        self._settings = settings
        self._jobs = jobs
        self._checks = checks
        self._owners = owners
        self._quotas = quotas
        self._shelf = shelf
        self._slots = Slots(MAX_IMPORTS, "imports of scenes")

    @contextlib.asynccontextmanager
    async def receive(self, name: str, blocks: AsyncIterator[bytes]) -> AsyncIterator[Path]:
        """Writes what arrives into a file, to be given to `accept` within this context; it is removed at the end.

        Raises InvalidArgument for a name that no scene can have, SceneExists, UploadTooLarge, QueueFull, LimitReached,
        StorageFull.
        """
        check_scene_name(name)
        await self._require_free(name)
        with self._slots.one():
            claim = contextlib.ExitStack()
            try:
                room, most = await self._quotas.room(self._jobs), self._settings.max_dataset_bytes
                with storage_full("the scene"), room.to_blame(most):
                    folder = await to_its_end(lambda: claim.enter_context(self._shelf.making()))
                    received = folder / f"{name}{SUFFIX}"
                    await self._write(received, blocks, room.at_most(most))
                    yield received
            finally:
                await to_its_end(claim.close)

    async def accept(self, received: Path, name: str, *, private: bool) -> SceneHeader:
        """Checks a file that was received and serves it as the scene `name`.

        Cancelling it ends the check. Raises SceneFileInvalid, SceneExists, StorageFull, MemoryExceeded,
        DeadlineExceeded.
        """
        await self._require_free(name)
        claim = Claim(self._owners, Kind.SCENE, name, received.parent.name, private=private)
        async with claim.held():
            if not await claim.take(partial(self._is_there, name)):
                await self._require_free(name)
                raise SceneExists(f"another import makes a scene {name!r}: choose another name", field="scene")
            await self._checks.run(
                check_scene_file,
                {"path": str(received)},
                what="checking the scene",
                timeout_s=SCENE_CHECK_TIMEOUT_S,
                killed=SceneFileInvalid,
            )
            header = await asyncio.to_thread(read_header, received)
            await self._require_free(name)
            await claim.spread()
            await to_its_end(lambda: self._publish(received, name, claim))
        return header

    async def delete(self, name: str) -> None:
        """Removes the file of a scene. Raises SceneNotFound, and SceneReadOnly for one of the data folder."""
        await asyncio.to_thread(self._store.require, name)
        async with self._owners.removing(Kind.SCENE, name):
            await asyncio.to_thread(self._delete, name)

    async def remove_stale(self) -> None:
        """Removes what services that died during an import left."""

        await asyncio.to_thread(self._shelf.remove_abandoned)

    async def _write(self, path: Path, blocks: AsyncIterator[bytes], max_bytes: int) -> None:
        received = 0
        with path.open("xb") as file:
            async for block in blocks:
                received += len(block)
                if received > max_bytes:
                    raise UploadTooLarge(f"a scene file may have at most {max_bytes} bytes", field="body")
                await asyncio.to_thread(file.write, block)
            await asyncio.to_thread(file.flush)
        await in_own_thread(lambda: sync(path))

    def _publish(self, received: Path, name: str, claim: Claim) -> None:
        try:
            self._shelf.publish(received, name)
        except SceneExists:  # another one was quicker
            raise self._exists(name) from None
        claim.is_made = True

    async def _is_there(self, name: str, claim: str | None) -> bool:
        """Whether the scene of a claim is there, or is being made: in this order it is not missed."""
        if claim is not None and await asyncio.to_thread(self._shelf.is_making, claim):
            return True
        if await self._jobs.makes_scene(name) is not None:
            return True
        return await asyncio.to_thread(self._store.shelf_of, name) is not None

    async def _require_free(self, name: str) -> None:
        if await asyncio.to_thread(self._store.shelf_of, name) is not None:
            raise await asyncio.to_thread(self._exists, name)
        if (maker := await self._jobs.makes_scene(name)) is not None:
            raise SceneExists(f"{maker} makes a scene {name!r}: choose another name", field="scene")

    def _exists(self, name: str) -> SceneExists:
        is_removable = self._store.shelf_of(name) is self._shelf
        advice = "delete it first, or choose another name" if is_removable else "choose another name"
        return SceneExists(f"there is already a scene {name!r}: {advice}", field="scene")

    def _delete(self, name: str) -> None:
        check_scene_name(name)
        self._store.require(name)
        if self._store.shelf_of(name) is not self._shelf:
            raise SceneReadOnly(
                f"the scene {name!r} lies in the data folder of the service: only scenes that were imported, or that "
                "jobs made, can be deleted",
                field="scene",
            )
        if not self._shelf.remove(name):
            raise SceneNotFound(f"there is no scene {name!r} any more", field="scene")
        self._store.forget(name)
