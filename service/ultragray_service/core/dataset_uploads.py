"""Uploads of datasets, from either front door: to the disk as they come, then checked in a process of their own."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Awaitable
from contextlib import asynccontextmanager
from contextvars import copy_context
from functools import partial
from typing import Any, TypeVar

from ultragray.contract import from_dict
from ultragray.datasets.source import SourceOptions
from ultragray.errors import DatasetInvalid
from ultragray_service.access.audit import account
from ultragray_service.access.limits.holdings import Holdings
from ultragray_service.access.limits.slots import Slots
from ultragray_service.access.owners import Claim, Owners
from ultragray_service.arrival import arrival
from ultragray_service.core.helper_processes import HelperProcesses
from ultragray_service.core.own_thread import to_its_end
from ultragray_service.settings import Settings
from ultragray_workers.datasets.incoming import IncomingDataset, remove_stale
from ultragray_workers.datasets.intake import take_in
from ultragray_workers.datasets.store import DatasetRecord, DatasetStore, check_dataset_name
from ultragray_workers.errors import Draining
from ultragray_workers.jobs.queue.owners import Kind

MAX_UPLOADS = 8
CHECK_TIMEOUT_S = 1800.0
_BLOCK_BYTES = 1 << 20
_POLL_INTERVAL_S = 0.25

_log = logging.getLogger("ultragray.service")

T = TypeVar("T")


class DatasetUploads:
    """The uploads under way. A few at a time are received, and wait for their turn in `checks`."""

    def __init__(
        self,
        store: DatasetStore,
        settings: Settings,
        draining: asyncio.Event,
        checks: HelperProcesses,
        owners: Owners,
        holdings: Holdings,
    ) -> None:
        self._store = store
        self._holdings = holdings
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
                room, most = await self._holdings.room(), self._settings.max_dataset_bytes
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
                take_in, arguments, what="checking the dataset", timeout_s=CHECK_TIMEOUT_S, killed=DatasetInvalid
            )
            while not await self._take_name():
                if await asyncio.to_thread(self._incoming.is_taken, self._name):
                    return await asyncio.to_thread(self._incoming.present, self._name), False
                await asyncio.sleep(_POLL_INTERVAL_S)  # another upload of the name is being checked
            await self._claim.spread()
            return await to_its_end(partial(copy_context().run, self._accept))

    async def _take_name(self) -> bool:
        """Whether the name is now this upload's; it is not where there is a dataset, whoever has it."""
        if await asyncio.to_thread(self._incoming.is_taken, self._name):
            return False
        return await self._claim.take(lambda claim: asyncio.to_thread(self._incoming.is_there, self._name, claim))

    def _accept(self) -> tuple[DatasetRecord, bool]:
        record, self._claim.is_made = self._incoming.accept(self._name)
        return record, self._claim.is_made

    async def ended(self) -> None:
        """Returns when a `finish` that was cancelled has ended its process."""
        async with self._finishing:
            pass
