"""Data sets and scenes that clients send, through any door: onto the disk as they come, then checked."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime, time, timedelta, timezone
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from ultragray.contract import from_dict
from ultragray.datasets.source import SourceOptions
from ultragray.errors import DatasetInvalid, SceneFileInvalid, UltragrayError
from ultragray.files import sync
from ultragray.phantom.demo import simulated_sha256
from ultragray.scene.info import SceneHeader, read_header
from ultragray_service.access.audit import account
from ultragray_service.access.limits import Limits, Slots
from ultragray_service.access.owners import Claim, Owners, may_change
from ultragray_service.access.principals import GB, acting
from ultragray_service.core.jobs import Jobs
from ultragray_service.core.threads import HelperProcesses, in_own_thread, to_its_end
from ultragray_service.errors import LimitReached, PermissionDenied, SceneReadOnly
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


Next = Callable[[Awaitable[T]], Awaitable[T]]


@contextmanager
def arrivals(draining: asyncio.Event, idle_timeout_s: float) -> Iterator[Next[Any]]:
    """A function that awaits the next part of what a client sends; it raises DeadlineExceeded and Draining."""
    stopping = asyncio.ensure_future(draining.wait())

    async def arrival(arriving: Awaitable[T]) -> T:
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

    try:
        yield arrival
    finally:
        stopping.cancel()


class Quotas:
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

    @asynccontextmanager
    async def room(self, jobs: Jobs, most: int) -> AsyncIterator[int]:
        """The bytes that an upload may have, where any may have `most`.

        Raises LimitReached where there may be none, and where the body finds too large what other keys might store.
        """
        left_bytes = None if self._limits.mine.stored_gb is None else await jobs.do(self._left_bytes)
        allowed = most if left_bytes is None else min(most, left_bytes)
        try:
            yield allowed
        except UploadTooLarge:
            if allowed == most:
                raise
            raise self._limits.refused("stored_gb", _too_many_bytes(self._limits.mine.stored_gb)) from None

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
                dataset_bytes += self._datasets.bytes_of(name)
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


MAX_UPLOADS = 8
DATASET_CHECK_TIMEOUT_S = 1800.0
_BLOCK_BYTES = 1 << 20
_POLL_INTERVAL_S = 0.25

_log = logging.getLogger("ultragray.service")


@dataclass(frozen=True, eq=False)
class Means:
    """What uploads of both kinds need."""

    settings: Settings
    jobs: Jobs
    draining: asyncio.Event
    checks: HelperProcesses
    owners: Owners
    quotas: Quotas


class DatasetUploads:
    """The uploads under way. A few at a time are received, and wait for their turn in `checks`."""

    def __init__(self, store: DatasetStore, means: Means) -> None:
        self._store, self._means = store, means
        self._slots = Slots(MAX_UPLOADS, "uploads of datasets")

    @asynccontextmanager
    async def receive(self, name: str, options: dict[str, str], *, private: bool) -> AsyncIterator[DatasetUpload]:
        """An upload; what is no dataset at the end goes. Raises InvalidArgument, QueueFull, LimitReached, Draining."""
        check_dataset_name(name)
        account().target = name
        from_dict(SourceOptions, options)
        means, settings = self._means, self._means.settings
        if means.draining.is_set():
            raise Draining("the service is stopping")
        with self._slots.one(), arrivals(means.draining, settings.upload_idle_timeout_s) as arrival:
            async with means.quotas.room(means.jobs, settings.max_dataset_bytes) as max_bytes:
                incoming = await asyncio.to_thread(IncomingDataset, self._store, max_bytes)
                claim = Claim(means.owners, Kind.DATASET, name, incoming.folder.name, private=private)
                upload = DatasetUpload(incoming, name, options, means.checks, claim, max_bytes, arrival)
                try:
                    yield upload
                finally:
                    await upload.ended()
                    await asyncio.shield(asyncio.to_thread(incoming.discard))

    async def remove_stale(self) -> None:
        if removed := await asyncio.to_thread(remove_stale, self._store):
            _log.info(f"removed {removed} uploads and deletions that were not finished")


class DatasetUpload:
    """`next`: awaits the next part of what the client sends, see `arrivals`."""

    def __init__(
        self,
        incoming: IncomingDataset,
        name: str,
        options: dict[str, str],
        checks: HelperProcesses,
        claim: Claim,
        max_bytes: int,
        arrival: Next[Any],
    ) -> None:
        self.next = arrival
        self._incoming, self._name, self._options = incoming, name, options
        self._checks, self._claim, self._max_bytes = checks, claim, max_bytes
        self._block = bytearray()
        self._finishing = asyncio.Lock()

    async def begin_file(self, name: str) -> None:
        await self._flush()
        await asyncio.to_thread(self._incoming.begin_file, name)

    async def begin_archive(self) -> None:
        await asyncio.to_thread(self._incoming.begin_archive)

    async def write(self, data: bytes) -> None:
        self._block += data
        if len(self._block) >= _BLOCK_BYTES:
            await self._flush()

    async def _flush(self) -> None:
        if self._block:
            block, self._block = bytes(self._block), bytearray()
            await asyncio.to_thread(self._incoming.write, block)

    async def finish(self, *, simulated: bool = False) -> tuple[DatasetRecord, bool]:
        """Checks what was sent and makes it a dataset; its record, and whether it is new. Raises DatasetInvalid.

        `simulated`: the built-in phantom, where nothing was sent.
        """
        async with self._finishing, self._claim.held():
            await self._flush()
            await asyncio.to_thread(self._incoming.finish)
            arguments = {
                "folder": str(self._incoming.folder),
                "name": self._name,
                "options": self._options,
                "max_bytes": self._max_bytes,
                "simulated": simulated,
            }
            if not await self._take_name() and simulated:
                store, sha256 = self._incoming.store, await asyncio.to_thread(simulated_sha256)
                if await asyncio.to_thread(store.is_taken, self._name):
                    return await asyncio.to_thread(store.held, self._name, sha256, {}), False
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
            return await to_its_end(self._accept)

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


SCENE_CHECK_TIMEOUT_S = 600.0
MAX_IMPORTS = 4
Make = Callable[[Path, Path | None], Awaitable[None]]  # writes a scene file, in place of another one


class SceneImports:
    """Takes scene files in, whole or not at all, onto a shelf of the store; and removes them."""

    def __init__(self, store: SceneStore, shelf: SceneShelf, means: Means) -> None:
        self._store, self._shelf, self._means = store, shelf, means
        self._slots = Slots(MAX_IMPORTS, "imports of scenes")

    @asynccontextmanager
    async def receive(self, name: str, blocks: AsyncIterator[bytes]) -> AsyncIterator[Path]:
        """Writes what arrives into a file, to be given to `accept` within this context; it is removed at the end."""
        check_scene_name(name)
        await self._require_free(name)
        async with self._room(name) as (file, max_bytes):
            await self._write(file, blocks, max_bytes)
            yield file

    async def accept(self, file: Path, name: str, *, private: bool) -> SceneHeader:
        """Checks a file that was received and serves it as the scene `name`; cancelling ends the check."""
        check = self._means.checks.run(
            check_scene_file,
            {"path": str(file)},
            what="checking the scene",
            timeout_s=SCENE_CHECK_TIMEOUT_S,
            killed=SceneFileInvalid,
        )
        return await self._named(file, name, check, private=private)

    async def make(self, name: str, make: Make, *, replace: bool, private: bool) -> SceneHeader:
        """Serves a file that `make` writes as the scene `name`; cancelling ends the making.

        With `replace` it takes the place of the scene of that name where there is one, which must be the caller's, and
        keeps its owner. Raises SceneExists, SceneReadOnly, PermissionDenied, LimitReached, QueueFull.
        """
        check_scene_name(name)
        before = await asyncio.to_thread(self._replaceable, name) if replace else None
        if before is None:
            await self._require_free(name)
        async with self._room(name) as (output, max_bytes):

            async def making() -> None:
                await make(output, None if before is None else await asyncio.to_thread(self._store.path, name))
                if output.stat().st_size > max_bytes:
                    raise UploadTooLarge(f"a scene file may have at most {max_bytes} bytes", field="body")

            if before is None:
                return await self._named(output, name, making(), private=private)
            await making()
            header = await asyncio.to_thread(read_header, output)
            await to_its_end(partial(self._replace, output, name, before))
            return header

    @asynccontextmanager
    async def _room(self, name: str) -> AsyncIterator[tuple[Path, int]]:
        """A place for the file of a scene, and the bytes that it may have; removed at the end of the body."""
        most = self._means.settings.max_dataset_bytes
        with self._slots.one():
            claim = contextlib.ExitStack()
            try:
                async with self._means.quotas.room(self._means.jobs, most) as max_bytes:
                    with storage_full("the scene"):
                        folder = await to_its_end(lambda: claim.enter_context(self._shelf.making()))
                        yield folder / f"{name}{SUFFIX}", max_bytes
            finally:
                await to_its_end(claim.close)

    async def _named(self, file: Path, name: str, work: Coroutine[Any, Any, None], *, private: bool) -> SceneHeader:
        """Claims a name, does the work that the file still needs, and serves it."""
        claim = Claim(self._means.owners, Kind.SCENE, name, file.parent.name, private=private)
        with contextlib.closing(work):
            await self._require_free(name)
            async with claim.held():
                if not await claim.take(partial(self._is_there, name)):
                    await self._require_free(name)
                    raise SceneExists(f"another import makes a scene {name!r}: choose another name", field="scene")
                await work
                header = await asyncio.to_thread(read_header, file)
                await self._require_free(name)
                await claim.spread()
                await to_its_end(lambda: self._publish(file, name, claim))
        return header

    def _replaceable(self, name: str) -> str | None:
        """The hash of a scene that the caller may replace; None where there is none."""
        if (shelf := self._store.shelf_of(name)) is None:
            return None
        if shelf is not self._shelf:
            raise _read_only(name)
        if not may_change(acting(), self._means.owners.known(Kind.SCENE, name)):
            raise PermissionDenied(f"the scene {name!r} is not yours: choose another name", field="scene")
        return self._store.sha256(name)

    def _replace(self, output: Path, name: str, before: str) -> None:
        if self._replaceable(name) != before:
            raise SceneExists(f"the scene {name!r} has become another one meanwhile: ask again", field="scene")
        sync(output)
        self._shelf.replace(output, name)
        self._store.forget(name)

    async def delete(self, name: str) -> None:
        await asyncio.to_thread(self._store.require, name)
        async with self._means.owners.removing(Kind.SCENE, name):
            await asyncio.to_thread(self._delete, name)

    async def remove_stale(self) -> None:
        await asyncio.to_thread(self._shelf.remove_abandoned)

    async def _write(self, path: Path, blocks: AsyncIterator[bytes], max_bytes: int) -> None:
        size = 0
        with path.open("xb") as file:
            async for block in blocks:
                size += len(block)
                if size > max_bytes:
                    raise UploadTooLarge(f"a scene file may have at most {max_bytes} bytes", field="body")
                await asyncio.to_thread(file.write, block)
            await asyncio.to_thread(file.flush)
        await in_own_thread(lambda: sync(path))

    def _publish(self, file: Path, name: str, claim: Claim) -> None:
        try:
            self._shelf.publish(file, name)
        except SceneExists:  # another one was quicker
            raise self._exists(name) from None
        claim.is_made = True

    async def _is_there(self, name: str, claim: str | None) -> bool:
        """Whether the scene of a claim is there, or is being made: in this order it is not missed."""
        if claim is not None and await asyncio.to_thread(self._shelf.is_making, claim):
            return True
        if await self._means.jobs.makes_scene(name) is not None:
            return True
        return await asyncio.to_thread(self._store.shelf_of, name) is not None

    async def _require_free(self, name: str) -> None:
        if await asyncio.to_thread(self._store.shelf_of, name) is not None:
            raise await asyncio.to_thread(self._exists, name)
        if (maker := await self._means.jobs.makes_scene(name)) is not None:
            raise SceneExists(f"{maker} makes a scene {name!r}: choose another name", field="scene")

    def _exists(self, name: str) -> SceneExists:
        is_removable = self._store.shelf_of(name) is self._shelf
        advice = "delete it first, or choose another name" if is_removable else "choose another name"
        return SceneExists(f"there is already a scene {name!r}: {advice}", field="scene")

    def _delete(self, name: str) -> None:
        check_scene_name(name)
        self._store.require(name)
        if self._store.shelf_of(name) is not self._shelf:
            raise _read_only(name)
        if not self._shelf.remove(name):
            raise SceneNotFound(f"there is no scene {name!r} any more", field="scene")
        self._store.forget(name)


def _read_only(name: str) -> SceneReadOnly:
    return SceneReadOnly(
        f"the scene {name!r} lies in the data folder of the service: only scenes that were imported, or that were made "
        "there, can be changed or deleted",
        field="scene",
    )
