"""The place of a storage as settings and commands name it, a path or the URL of a bucket, and the storage there."""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import unquote, urlsplit

from ultragray.errors import InvalidArgument
from ultragray_workers.storage.local import LocalStorage
from ultragray_workers.storage.storage import Storage
from ultragray_workers.storage.storage import StorageUrl as StorageUrl

PATIENCE_S = 20.0
_SCHEMES = ("s3", "gs", "az")
_KNOWN = "a path, file:///FOLDER, s3://BUCKET/PREFIX, gs://BUCKET/PREFIX or az://CONTAINER/PREFIX"
_BUCKET = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_PREFIX = re.compile(r"[A-Za-z0-9._~=/-]*")


Location = Path | StorageUrl


def parse_location(location: str | Path | StorageUrl, field: str) -> Location:
    """A folder, or the URL of a bucket; `file://` is a folder.

    Raises InvalidArgument, which names `field`, for other URLs and those with credentials, a query or a fragment.
    """
    if not isinstance(location, str):
        return location
    if "://" not in location:
        return Path(location)
    scheme = location.partition("://")[0].lower()
    if scheme not in (*_SCHEMES, "file"):
        raise InvalidArgument(f"{field} must be {_KNOWN}, got a URL with the scheme {scheme!r}", field=field)
    try:
        parts = urlsplit(location)
    except ValueError as error:
        raise InvalidArgument(f"{field} must be {_KNOWN}: {error}", field=field) from None
    if "@" in parts.netloc:
        raise InvalidArgument(
            f"{field} must hold no credentials: give them in the environment variables of the storage, such as "
            "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY",
            field=field,
        )
    if parts.query or parts.fragment:
        raise InvalidArgument(
            f"{field} must have neither ? nor #, got one after {location[: len(scheme) + 3]}…", field=field
        )
    if scheme == "file":
        if parts.netloc not in ("", "localhost") or not parts.path.startswith("/"):
            raise InvalidArgument(
                f"{field} must name a folder of this machine, as file:///FOLDER, got {location!r}", field=field
            )
        return Path(unquote(parts.path))
    if not _BUCKET.fullmatch(parts.netloc):
        raise InvalidArgument(f"{field} must name a bucket, as {scheme}://BUCKET/PREFIX, got {location!r}", field=field)
    prefix = parts.path.strip("/")
    if not _PREFIX.fullmatch(prefix) or any(part in ("", ".", "..") for part in prefix.split("/") if prefix):
        raise InvalidArgument(
            f"{field} must have a prefix of letters, digits, '.', '_', '~', '=', '-' between slashes, got {prefix!r}",
            field=field,
        )
    return StorageUrl(scheme, parts.netloc, prefix)


def open_storage(location: str | Path | StorageUrl, *, patience_s: float = PATIENCE_S) -> Storage:
    """The storage of a folder (a path, or file://), or of a bucket (s3://, gs://, az://). Nothing is asked of it yet.

    `patience_s`: how long a request to a bucket is repeated before StorageUnavailable.
    Raises InvalidArgument for another URL, ExtraMissing where obstore is not installed.
    """
    place = parse_location(location, "location")
    if isinstance(place, Path):
        return LocalStorage(place)
    from ultragray_workers.storage.remote import RemoteStorage

    return RemoteStorage(place, patience_s=patience_s)


def below(location: Location, key: str) -> Location:
    """The place of the objects of a location whose keys begin with `key` and a slash."""
    return location / key if isinstance(location, Path) else location.below(key)
