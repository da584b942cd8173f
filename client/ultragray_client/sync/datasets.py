# Generated from aio/datasets.py by client/generate.py; change that file.
"""The datasets of a service."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

from ultragray_client.conversations import Upload
from ultragray_proto.codec import from_message
from ultragray_proto.v1 import datasets_pb2, datasets_pb2_grpc

from ..contract import Dataset, DatasetOptions
from .connection import Connection
from .transport import run_blocking


class Datasets:
    """`client.datasets`. All raise ClientError; a name that does not exist is DatasetNotFound."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._calls = datasets_pb2_grpc.DatasetServiceStub(connection.channel)

    def upload(
        self,
        name: str,
        path: str | Path,
        *,
        options: DatasetOptions | None = None,
        private: bool = False,
        timeout_s: float | None = None,
    ) -> Dataset:
        """Uploads a folder with all below it, or an archive (.zip, .tar, .tar.gz, .tgz), and waits until it is checked.

        Others do not see a `private` one. The same content and options again give the dataset that is there. Without
        `timeout_s` it takes as long as it takes. Raises DatasetInvalid with the file and the frame, DatasetExists,
        UploadTooLarge, StorageFull.
        """
        messages = partial(_read, Upload(name, path, options or DatasetOptions(), private))
        answer = self._connection.upload(self._calls.UploadDataset, messages, timeout_s)
        return from_message(answer.dataset, Dataset)

    def list(self, *, timeout_s: float | None = None) -> tuple[Dataset, ...]:
        """All datasets by name."""
        request = datasets_pb2.ListDatasetsRequest()
        datasets = self._connection.listed(self._calls.ListDatasets, request, "datasets", timeout_s)
        return tuple(from_message(dataset, Dataset) for dataset in datasets)

    def get(self, name: str, *, timeout_s: float | None = None) -> Dataset:
        """One dataset."""
        request = datasets_pb2.GetDatasetRequest(dataset=name)
        return from_message(self._connection.answer(self._calls.GetDataset, request, timeout_s), Dataset)

    def contact_sheet(self, name: str, *, timeout_s: float | None = None) -> bytes:
        """A PNG of the image planes in space and of some frames."""
        request = datasets_pb2.GetContactSheetRequest(dataset=name)
        return bytes((self._connection.answer(self._calls.GetContactSheet, request, timeout_s)).png)

    def delete(self, name: str, *, timeout_s: float | None = None) -> None:
        """Raises DatasetInUse where a job needs it."""
        request = datasets_pb2.DeleteDatasetRequest(dataset=name)
        self._connection.delete(self._calls.DeleteDataset, request, timeout_s)


def _read(upload: Upload) -> Iterator[datasets_pb2.UploadDatasetRequest]:
    """The messages of an upload."""
    messages = upload.messages()
    while (message := run_blocking(next, messages, None)) is not None:
        yield message
