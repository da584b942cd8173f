"""The datasets as all front doors tell them, read without blocking the event loop."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from dataclasses import dataclass, replace

from ultragray.contract import described
from ultragray.errors import DatasetInvalid
from ultragray_service.core.scenes import page_of_names
from ultragray_service.service import Service
from ultragray_workers.datasets.store import DatasetRecord, DatasetStore
from ultragray_workers.errors import DatasetNotFound
from ultragray_workers.jobs.owners import Kind


@dataclass(frozen=True)
class DatasetPage:
    """One page of datasets by name."""

    datasets: list[DatasetRecord]
    next_page_token: str = described("Empty on the last page.")


def with_owner(service: Service, record: DatasetRecord) -> DatasetRecord:
    """A dataset, told with whose it is."""
    ownership = service.owners.known(Kind.DATASET, record.name)
    return replace(record, owner=ownership.owner, private=ownership.private)


async def dataset(service: Service, name: str) -> DatasetRecord:
    """One dataset. Raises DatasetNotFound, DatasetInvalid."""
    return with_owner(service, await asyncio.to_thread(service.datasets.get, name))


async def dataset_page(service: Service, page_size: int, page_token: str) -> DatasetPage:
    """The datasets of one page; those whose manifest is damaged are left out. Raises InvalidArgument."""

    store = service.datasets

    def read() -> DatasetPage:
        names, next_page_token = page_of_names(store.shown_names(), page_size, page_token)
        records = []
        for name in names:
            with suppress(DatasetNotFound, DatasetInvalid):
                records.append(with_owner(service, store.get(name)))
        return DatasetPage(records, next_page_token)

    return await asyncio.to_thread(read)


async def contact_sheet(store: DatasetStore, name: str) -> bytes:
    """The PNG of a dataset. Raises DatasetNotFound."""
    return await asyncio.to_thread(store.contact_sheet, name)
