"""The messages of an upload."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from ultragray_proto.v1 import datasets_pb2

from .contract import DatasetOptions
from .errors import InvalidArgument
from .messages import message_of

_CHUNK_BYTES = 2**20
_ARCHIVE_SUFFIXES = (".zip", ".tar", ".tar.gz", ".tgz")


class Upload:
    """A folder with all below it, or one archive (.zip, .tar, .tar.gz, .tgz), on its way to the service."""

    def __init__(self, name: str, path: str | Path, options: DatasetOptions, private: bool) -> None:
        """Raises InvalidArgument for a path that is neither."""
        self._name, self._path, self._options, self._private = name, Path(path), options, private
        if not self._path.is_dir() and not (self._path.is_file() and self._path.name.endswith(_ARCHIVE_SUFFIXES)):
            expected = f"a folder or an archive ({', '.join(_ARCHIVE_SUFFIXES)})"
            raise InvalidArgument(f"path must be {expected} that exists, got {self._path}", field="path")

    def messages(self) -> Iterator[datasets_pb2.UploadDatasetRequest]:
        """The header, then the files in chunks of 1 MiB. Raises OSError."""
        request = datasets_pb2.UploadDatasetRequest
        options = message_of(self._options, datasets_pb2.DatasetOptions)
        archive = self._path.is_file()
        header = datasets_pb2.UploadHeader(dataset=self._name, options=options, archive=archive, private=self._private)
        yield request(header=header)
        for path in [self._path] if archive else sorted(self._path.rglob("*")):
            if not path.is_file():
                continue
            if not archive:
                yield request(file=path.relative_to(self._path).as_posix())
            with path.open("rb") as file:
                while chunk := file.read(_CHUNK_BYTES):
                    yield request(chunk=chunk)
