"""The storage at a location."""

from __future__ import annotations

from pathlib import Path

from ultragray_workers.storage.local import LocalStorage
from ultragray_workers.storage.location import StorageUrl, parse_location
from ultragray_workers.storage.remote import RemoteStorage
from ultragray_workers.storage.storage import Storage

PATIENCE_S = 20.0


def open_storage(location: str | Path | StorageUrl, *, patience_s: float = PATIENCE_S) -> Storage:
    """The storage of a folder (a path, or file://), or of a bucket (s3://, gs://, az://). Nothing is asked of it yet.

    `patience_s`: how long a request to a bucket is repeated before StorageUnavailable.
    Raises InvalidArgument for another URL, ExtraMissing where obstore is not installed.
    """
    found = parse_location(location, "location")
    return LocalStorage(found) if isinstance(found, Path) else RemoteStorage(found, patience_s=patience_s)
