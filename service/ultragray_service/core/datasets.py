"""The datasets as all front doors tell them, read without blocking the event loop."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Set
from contextlib import suppress
from dataclasses import dataclass, replace

from ultragray.contract import described
from ultragray.errors import DatasetInvalid
from ultragray_service.access.owners import Owners
from ultragray_service.core.scenes import page_of_names
from ultragray_workers.datasets.store import DatasetRecord, DatasetStore
from ultragray_workers.errors import DatasetNotFound
from ultragray_workers.jobs.owners import Kind


@dataclass(frozen=True)
class DatasetPage:
    """One page of datasets by name."""

    datasets: list[DatasetRecord]
    next_page_token: str = described("Empty on the last page.")


class Datasets:
    def __init__(self, store: DatasetStore, owners: Owners) -> None:
        self._store, self._owners = store, owners

    def with_owner(self, record: DatasetRecord) -> DatasetRecord:
        ownership = self._owners.known(Kind.DATASET, record.name)
        return replace(record, owner=ownership.owner, private=ownership.private)

    async def get(self, name: str) -> DatasetRecord:
        return self.with_owner(await asyncio.to_thread(self._store.get, name))

    async def page(self, page_size: int, page_token: str) -> DatasetPage:
        """The datasets of one page; those whose manifest is damaged are left out. Raises InvalidArgument."""

        def read() -> DatasetPage:
            names, next_page_token = page_of_names(self._store.shown_names(), page_size, page_token)
            records = []
            for name in names:
                with suppress(DatasetNotFound, DatasetInvalid):
                    records.append(self.with_owner(self._store.get(name)))
            return DatasetPage(records, next_page_token)

        return await asyncio.to_thread(read)

    async def contact_sheet(self, name: str) -> bytes:
        def read() -> bytes:
            try:
                return self._store.contact_sheet(name)
            except FileNotFoundError:  # deleted a moment ago
                raise DatasetNotFound(f"there is no dataset {name!r} any more", field="dataset") from None

        return await asyncio.to_thread(read)

    async def delete(self, name: str, in_use: Callable[[str], str | None]) -> str | None:
        """Deletes a dataset; its SHA-256 if no other has it. Raises DatasetNotFound, DatasetInUse."""
        deleted = (await asyncio.to_thread(self._store.get, name)).sha256
        async with self._owners.removing(Kind.DATASET, name):
            await asyncio.to_thread(self._store.delete, name, in_use)
        return None if deleted in await self.contents() else deleted

    async def contents(self) -> Set[str]:
        return (await asyncio.to_thread(self._store.names_by_content)).keys()
