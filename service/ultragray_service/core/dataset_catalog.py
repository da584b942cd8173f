"""What both front doors tell about datasets, read without blocking the event loop."""

from __future__ import annotations

import asyncio

from ultragray.errors import DatasetInvalid
from ultragray_workers.datasets.store import DatasetRecord, DatasetStore
from ultragray_workers.errors import DatasetNotFound

from .catalog import page_of_names


async def dataset_page(store: DatasetStore, page_size: int, page_token: str) -> tuple[list[DatasetRecord], str]:
    """One page of datasets by name and the token of the next (empty on the last). Raises InvalidArgument."""

    def read() -> tuple[list[DatasetRecord], str]:
        names, next_page_token = page_of_names(store.names(), page_size, page_token)
        records = [record for name in names if (record := _readable(store, name)) is not None]
        return records, next_page_token

    return await asyncio.to_thread(read)


async def contact_sheet(store: DatasetStore, name: str) -> bytes:
    """The PNG of a dataset. Raises DatasetNotFound."""

    def read() -> bytes:
        try:
            return store.contact_sheet(name).read_bytes()
        except FileNotFoundError:  # deleted a moment ago
            raise DatasetNotFound(f"there is no dataset {name!r} any more", field="dataset") from None

    return await asyncio.to_thread(read)


def _readable(store: DatasetStore, name: str) -> DatasetRecord | None:
    try:
        return store.get(name)
    except (DatasetNotFound, DatasetInvalid):  # deleted since the folder was read, or no manifest of ours
        return None
