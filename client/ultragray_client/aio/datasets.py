"""The datasets of a service."""

from __future__ import annotations

from collections.abc import AsyncIterator
from functools import partial
from pathlib import Path

from ultragray_proto.v1 import datasets_pb2

from ..connection import Pages
from ..datasets import (
    Dataset,
    DatasetOptions,
    Upload,
    contact_sheet,
    delete_dataset,
    get_dataset,
    list_datasets,
    upload_dataset,
)
from .connection import AsyncConnection
from .transport import run_blocking


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
        return await self._connection.answer_upload(upload_dataset(), partial(_read, upload), timeout_s)

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
        await self._connection.answer(delete_dataset(name), timeout_s)


async def _read(upload: Upload) -> AsyncIterator[datasets_pb2.UploadDatasetRequest]:
    """The messages of an upload."""
    messages = upload.messages()
    while (message := await run_blocking(next, messages, None)) is not None:
        yield message
