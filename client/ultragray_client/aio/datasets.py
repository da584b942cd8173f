"""The datasets of a service."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path

import grpc

from ultragray_proto.v1 import datasets_pb2

from ..connection import Pages
from ..datasets import (
    Dataset,
    DatasetOptions,
    Upload,
    contact_sheet,
    dataset_from_message,
    delete_dataset,
    get_dataset,
    list_datasets,
)
from ..statuses import error_of_call
from .connection import AsyncConnection


class AsyncDatasets:
    """`client.datasets`. All raise ClientError; a name that does not exist is DatasetNotFound."""

    def __init__(self, connection: AsyncConnection) -> None:
        self._connection = connection

    async def upload(
        self,
        name: str,
        path: str | Path,
        *,
        options: DatasetOptions | None = None,
        timeout_s: float | None = None,
    ) -> Dataset:
        """Uploads a folder with all below it, or an archive (.zip, .tar, .tar.gz, .tgz), and waits until it is checked.

        The same content and options again give the dataset that is there. Without `timeout_s` it takes as long as it
        takes. Raises DatasetInvalid with the file and the frame, DatasetExists, UploadTooLarge, StorageFull.
        """
        upload = Upload(name, path, options or DatasetOptions())
        retries = self._connection.retries(timeout_s)
        while True:
            try:
                answer = await self._connection.stubs.datasets.UploadDataset(
                    _read(upload), timeout=retries.remaining_s(), metadata=self._connection.metadata
                )
            except grpc.RpcError as failure:
                await asyncio.sleep(retries.pause_s(error_of_call(failure, self._connection.address)))
            else:
                return dataset_from_message(answer.dataset)

    async def list(self, *, timeout_s: float | None = None) -> tuple[Dataset, ...]:
        """All datasets by name."""
        return await self._connection.all_pages(Pages(list_datasets, None), timeout_s)

    async def get(self, name: str, *, timeout_s: float | None = None) -> Dataset:
        """One dataset."""
        return await self._connection.answer(get_dataset(name), timeout_s)

    async def contact_sheet(self, name: str, *, timeout_s: float | None = None) -> bytes:
        """A PNG of the image planes in space and of some frames."""
        return await self._connection.answer(contact_sheet(name), timeout_s)

    async def delete(self, name: str, *, timeout_s: float | None = None) -> None:
        """Raises DatasetInUse where a job needs it."""
        await self._connection.run(delete_dataset(name), timeout_s)


async def _read(upload: Upload) -> AsyncIterator[datasets_pb2.UploadDatasetRequest]:
    """Its messages, read from the disk in a thread."""
    messages = upload.messages()
    while (message := await asyncio.to_thread(next, messages, None)) is not None:
        yield message
