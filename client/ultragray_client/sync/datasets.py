# Generated from aio/datasets.py by client/generate.py; change that file.
"""The datasets of a service."""

from __future__ import annotations

from collections.abc import Iterator
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
from .connection import Connection
from .transport import run_blocking


class Datasets:
    """`client.datasets`. All raise ClientError; a name that does not exist is DatasetNotFound."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def upload(
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
        return self._connection.answer_upload(upload_dataset(), partial(_read, upload), timeout_s)

    def list(self, *, timeout_s: float | None = None) -> tuple[Dataset, ...]:
        """All datasets by name."""
        return self._connection.all_pages(Pages(list_datasets, None), timeout_s)

    def get(self, name: str, *, timeout_s: float | None = None) -> Dataset:
        """One dataset."""
        return self._connection.answer(get_dataset(name), timeout_s)

    def contact_sheet(self, name: str, *, timeout_s: float | None = None) -> bytes:
        """A PNG of the image planes in space and of some frames."""
        return self._connection.answer(contact_sheet(name), timeout_s)

    def delete(self, name: str, *, timeout_s: float | None = None) -> None:
        """Raises DatasetInUse where a job needs it."""
        self._connection.answer(delete_dataset(name), timeout_s)


def _read(upload: Upload) -> Iterator[datasets_pb2.UploadDatasetRequest]:
    """The messages of an upload."""
    messages = upload.messages()
    while (message := run_blocking(next, messages, None)) is not None:
        yield message
