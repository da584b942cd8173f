"""The place of a storage as settings and commands name it: a path, or the URL of a bucket."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote, urlsplit

from ultragray.errors import InvalidArgument

_SCHEMES = ("s3", "gs", "az")
_KNOWN = "a path, file:///FOLDER, s3://BUCKET/PREFIX, gs://BUCKET/PREFIX or az://CONTAINER/PREFIX"
_BUCKET = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_PREFIX = re.compile(r"[A-Za-z0-9._~=/-]*")


@dataclass(frozen=True)
class StorageUrl:
    """A bucket (of Azure, a container) of an object storage, and what the keys in it begin with; without credentials.

    `scheme` is s3, gs or az; `prefix` neither begins nor ends with a slash, and may be empty.
    """

    scheme: str
    bucket: str
    prefix: str = ""

    def __str__(self) -> str:
        return f"{self.scheme}://{self.bucket}/{self.prefix}".rstrip("/")

    def below(self, key: str) -> StorageUrl:
        """The place of the objects whose keys begin with `key` and a slash."""
        return StorageUrl(self.scheme, self.bucket, f"{self.prefix}/{key}".strip("/"))


Location = Path | StorageUrl


def parse_location(given: str | Path | StorageUrl, field: str) -> Location:
    """A folder, or the URL of a bucket; `file://` is a folder.

    Raises InvalidArgument, which names `field`, for other URLs and those with credentials, a query or a fragment.
    """
    if not isinstance(given, str):
        return given
    if "://" not in given:
        return Path(given)
    scheme = given.partition("://")[0].lower()
    if scheme not in (*_SCHEMES, "file"):
        raise InvalidArgument(f"{field} must be {_KNOWN}, got a URL with the scheme {scheme!r}", field=field)
    try:
        parts = urlsplit(given)
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
            f"{field} must have neither ? nor #, got one after {given[: len(scheme) + 3]}…", field=field
        )
    if scheme == "file":
        if parts.netloc not in ("", "localhost") or not parts.path.startswith("/"):
            raise InvalidArgument(
                f"{field} must name a folder of this machine, as file:///FOLDER, got {given!r}", field=field
            )
        return Path(unquote(parts.path))
    if not _BUCKET.fullmatch(parts.netloc):
        raise InvalidArgument(f"{field} must name a bucket, as {scheme}://BUCKET/PREFIX, got {given!r}", field=field)
    prefix = parts.path.strip("/")
    if not _PREFIX.fullmatch(prefix) or any(part in ("", ".", "..") for part in prefix.split("/") if prefix):
        raise InvalidArgument(
            f"{field} must have a prefix of letters, digits, '.', '_', '~', '=', '-' between slashes, got {prefix!r}",
            field=field,
        )
    return StorageUrl(scheme, parts.netloc, prefix)
