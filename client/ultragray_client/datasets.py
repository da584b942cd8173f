"""Datasets as values, what can be asked about them, and an upload as messages."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from ultragray_proto.v1 import datasets_pb2

from .connection import Operation
from .errors import InvalidArgument
from .geometry import Probe, probe_from_message

_CHUNK_BYTES = 2**20
_ARCHIVE_SUFFIXES = (".zip", ".tar", ".tar.gz", ".tgz")


@dataclass(frozen=True, kw_only=True)
class DatasetOptions:
    """How a dataset is read, as the options of `ultragray dataset check`; empty: as it is stored."""

    crop: str = ""  # columns,rows of a sequence's image: 188:632,12:600
    image_size: str = ""  # WIDTHxHEIGHT
    frames: str = ""  # frames of a sequence to read at all: 0:90,100:120:2
    train_frames: str = ""
    val_frames: str = ""


@dataclass(frozen=True)
class Dataset:
    """A tracked sweep that the service keeps."""

    name: str
    kind: str  # "released" or "plus"
    sha256: str
    bytes: int
    created_at: str  # ISO 8601, UTC
    train_frames: int
    val_frames: int
    height: int
    width: int
    probe: Probe | None
    warnings: tuple[str, ...]
    options: DatasetOptions


class Upload:
    """A folder with all below it, or one archive (.zip, .tar, .tar.gz, .tgz), on its way to the service."""

    def __init__(self, name: str, path: str | Path, options: DatasetOptions) -> None:
        """Raises InvalidArgument for a path that is neither."""
        self._name, self._path, self._options = name, Path(path), options
        if not self._path.is_dir() and not (self._path.is_file() and self._path.name.endswith(_ARCHIVE_SUFFIXES)):
            expected = f"a folder or an archive ({', '.join(_ARCHIVE_SUFFIXES)})"
            raise InvalidArgument(f"path must be {expected} that exists, got {self._path}", field="path")

    def messages(self) -> Iterator[datasets_pb2.UploadDatasetRequest]:
        """The header, then the files in chunks of 1 MiB. Raises OSError."""
        request = datasets_pb2.UploadDatasetRequest
        options = datasets_pb2.DatasetOptions(**vars(self._options))
        archive = self._path.is_file()
        yield request(header=datasets_pb2.UploadHeader(dataset=self._name, options=options, archive=archive))
        for path in [self._path] if archive else sorted(self._path.rglob("*")):
            if not path.is_file():
                continue
            if not archive:
                yield request(file=path.relative_to(self._path).as_posix())
            with path.open("rb") as file:
                while chunk := file.read(_CHUNK_BYTES):
                    yield request(chunk=chunk)


def upload_dataset() -> Operation[Dataset]:
    """An upload but for its messages."""
    return Operation("datasets.UploadDataset", None, lambda answer: dataset_from_message(answer.dataset))


def list_datasets(page_size: int, page_token: str) -> Operation[tuple[list[Dataset], str]]:
    request = datasets_pb2.ListDatasetsRequest(page_size=page_size, page_token=page_token)
    return Operation(
        "datasets.ListDatasets",
        request,
        lambda answer: ([dataset_from_message(dataset) for dataset in answer.datasets], answer.next_page_token),
    )


def get_dataset(name: str) -> Operation[Dataset]:
    return Operation("datasets.GetDataset", datasets_pb2.GetDatasetRequest(dataset=name), dataset_from_message)


def contact_sheet(name: str) -> Operation[bytes]:
    request = datasets_pb2.GetContactSheetRequest(dataset=name)
    return Operation("datasets.GetContactSheet", request, lambda answer: bytes(answer.png))


def delete_dataset(name: str) -> Operation[None]:
    request = datasets_pb2.DeleteDatasetRequest(dataset=name)
    return Operation("datasets.DeleteDataset", request, lambda answer: None, deletes=True)


def dataset_from_message(message: datasets_pb2.Dataset) -> Dataset:
    options = message.options
    return Dataset(
        name=message.name,
        kind=message.kind,
        sha256=message.sha256,
        bytes=message.bytes,
        created_at=message.created_at,
        train_frames=message.train_frames,
        val_frames=message.val_frames,
        height=message.height,
        width=message.width,
        probe=probe_from_message(message.probe),
        warnings=tuple(message.warnings),
        options=DatasetOptions(**{name: getattr(options, name) for name in vars(DatasetOptions())}),
    )
