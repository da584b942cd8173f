"""A bucket of an object storage (S3 and what speaks like it, Google Cloud Storage, Azure), by obstore.

What the URL does not say, obstore takes from the usual environment variables: AWS_*, GOOGLE_*, AZURE_*. It repeats
requests that fail with growing pauses, and goes on with a torn download where that broke off.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import threading
from collections.abc import Iterator, Mapping
from datetime import timedelta
from pathlib import Path
from typing import Any

from ultragray.errors import InvalidArgument
from ultragray.files import atomic_path
from ultragray.installation import missing_extra
from ultragray_workers.errors import StorageUnavailable
from ultragray_workers.storage.cache import Cache
from ultragray_workers.storage.storage import Entry, NotThere, StorageUrl, check_key

_ENVIRONMENT = {"s3": "AWS", "gs": "GOOGLE", "az": "AZURE"}
_CONNECT_TIMEOUT_S, _SILENCE_TIMEOUT_S = 5, 30  # a request that hears nothing so long is repeated
_REQUEST_TIMEOUT_S = 3600  # of a whole request: the largest object over the slowest line
_LONGEST_PAUSE_S = 5
_SINGLE_REQUEST_BYTES = 16 * 2**20  # larger files are uploaded in parts
_PART_BYTES, _MOST_PARTS, _PARTS_AT_ONCE = 8 * 2**20, 9000, 4  # S3 takes 10,000 parts
_PIECE_BYTES = 2**18  # of a download: what is lost at most where it is torn
_CLAIMS = "claims"  # prefix of keys: who claims a token says so again and again; the clock is the bucket's
REFRESH_S, DEAD_AFTER_S = 10.0, 60.0
_STATUS = re.compile(r"Server returned non-2xx status code: (\d{3}[ A-Za-z]*)")
_REFUSED = re.compile(r"NoSuchBucket|ContainerNotFound|specified bucket does not exist")


class _BeyondTheEnd(Exception):
    """A range that begins at the end of an object or later."""


class RemoteStorage:
    """The objects of a bucket whose keys begin with a prefix."""

    is_near = False

    def __init__(self, url: StorageUrl, *, patience_s: float) -> None:
        """`patience_s`: how long a request that fails is repeated. Raises ExtraMissing, InvalidArgument."""
        try:
            import obstore.exceptions
            from obstore.store import from_url
        except ImportError as error:
            raise missing_extra(error, f"object storage ({url})") from error
        self.location = str(url)
        self._obstore = obstore
        self._errors: tuple[type[Exception], ...] = (obstore.exceptions.BaseError, OSError, ValueError)
        self._conflicts = (obstore.exceptions.AlreadyExistsError, obstore.exceptions.PreconditionError)
        try:
            self._store = from_url(
                self.location,
                client_options=_client_options(url.scheme),
                retry_config={
                    "max_retries": 1000,  # the time limits them
                    "retry_timeout": timedelta(seconds=patience_s),
                    "backoff": {"max_backoff": timedelta(seconds=_LONGEST_PAUSE_S)},
                },
            )
        except self._errors as error:
            raise InvalidArgument(f"{url} cannot be opened: {_first_line(error)}") from None

    def entries(self, prefix: str = "") -> Iterator[Entry]:
        with self._asking():
            pages = iter(self._obstore.list(self._store, check_key(prefix) if prefix else None))
        while True:
            with self._asking():
                page = next(pages, None)
            if page is None:
                return
            for item in page:
                yield _entry(item)

    def entries_in(self, prefix: str = "") -> Iterator[Entry]:
        with self._asking():
            page = self._obstore.list_with_delimiter(self._store, check_key(prefix) if prefix else None)
        yield from map(_entry, page["objects"])

    def entry(self, key: str) -> Entry | None:
        try:
            with self._asking(key):
                return _entry(self._obstore.head(self._store, check_key(key)))
        except NotThere:
            return None

    def read(self, key: str, *, start: int = 0, length: int | None = None) -> bytes:
        if length == 0:
            return b""
        options: dict[str, Any] = {}
        if length is not None:
            options["range"] = (start, start + length)
        elif start:
            options["range"] = {"offset": start}
        try:
            with self._asking(key):
                return bytes(self._obstore.get(self._store, check_key(key), options=options).bytes())
        except _BeyondTheEnd:
            return b""

    def write(self, key: str, data: bytes, *, if_absent: bool = False) -> bool:
        mode: Any = "create" if if_absent else "overwrite"
        try:
            with self._asking():
                self._obstore.put(self._store, check_key(key), data, mode=mode, use_multipart=False)
        except self._conflicts:
            try:
                return self.read(key) == data  # then a write whose answer was lost has succeeded
            except NotThere:
                return False
        return True

    def upload(self, path: Path, key: str, *, if_absent: bool = False) -> bool:
        size = path.stat().st_size
        if size <= _SINGLE_REQUEST_BYTES:
            return self.write(key, path.read_bytes(), if_absent=if_absent)
        if if_absent and self.entry(key) is not None:
            return False
        with self._asking():
            self._obstore.put(
                self._store,
                check_key(key),
                path,
                use_multipart=True,
                chunk_size=max(_PART_BYTES, size // _MOST_PARTS + 1),
                max_concurrency=_PARTS_AT_ONCE,
            )
        return True

    def download(self, key: str, path: Path, *, version: str | None = None) -> Entry:
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            entry, pieces = self._stream(key, 0, version)
            while (before := file.tell()) < entry.bytes:
                try:
                    while piece := self._next(key, pieces):
                        file.write(piece)
                except StorageUnavailable:
                    # obstore goes on itself as long as its patience lasts, which it counts from the first byte on.
                    if file.tell() == before:
                        raise
                    _, pieces = self._stream(key, file.tell(), entry.version)
                    continue
                if file.tell() != entry.bytes:
                    raise StorageUnavailable(f"{self.location} sent {file.tell()} of the {entry.bytes} bytes of {key}")
        return entry

    def _stream(self, key: str, start: int, version: str | None) -> tuple[Entry, Iterator[Any]]:
        """The bytes of an object from one on, in pieces. Raises NotThere where it is of another version by now."""
        options: dict[str, Any] = {} if version is None else {"if_match": version}
        if start:
            options["range"] = {"offset": start}
        try:
            with self._asking(key):
                result = self._obstore.get(self._store, check_key(key), options=options)
        except self._conflicts:
            raise NotThere(f"{key} in {self.location} is no longer of the version {version}") from None
        return _entry(result.meta), iter(result.stream(min_chunk_size=_PIECE_BYTES))

    def _next(self, key: str, pieces: Iterator[Any]) -> Any:
        with self._asking(key):
            return next(pieces, None)

    def delete(self, key: str) -> None:
        with contextlib.suppress(NotThere), self._asking(key):
            self._obstore.delete(self._store, check_key(key))

    def delete_all(self, prefix: str) -> None:
        keys = [entry.key for entry in self.entries(prefix)]
        with contextlib.suppress(NotThere), self._asking(prefix):
            self._obstore.delete(self._store, keys)

    def delete_half_written(self, prefix: str) -> None:
        """Does nothing: an object is there whole or not at all."""

    @contextlib.contextmanager
    def held(self, prefix: str, sha256: Mapping[str, str], folder: Path, max_bytes: int) -> Iterator[Path]:
        with Cache(folder / ".copies", max_bytes, keep_s=0.0).copies(self, prefix, sha256) as copy:
            yield copy

    @contextlib.contextmanager
    def claimed(self, token: str) -> Iterator[None]:
        key = f"{_CLAIMS}/{token}"
        self.write(key, secrets.token_bytes(8))
        ended = threading.Event()

        def refresh() -> None:
            while not ended.wait(REFRESH_S):
                with contextlib.suppress(StorageUnavailable):  # others ask the same storage
                    self.write(key, secrets.token_bytes(8))

        thread = threading.Thread(target=refresh, name="claim", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()
            with contextlib.suppress(StorageUnavailable):
                self.delete(key)

    def is_claimed(self, token: str) -> bool:
        claim = self.entry(f"{_CLAIMS}/{token}")
        if claim is None:
            return False
        probe = f"{_CLAIMS}/now-{secrets.token_hex(8)}"
        self.write(probe, b"")
        try:
            now = self.entry(probe)
        finally:
            self.delete(probe)
        return now is None or now.modified - claim.modified < DEAD_AFTER_S

    def in_place(self, key: str) -> Path | None:
        return None

    def free_bytes(self) -> int | None:
        return None

    @contextlib.contextmanager
    def _asking(self, key: str | None = None) -> Iterator[None]:
        """What obstore raises, in our words; the conflicts of conditional requests pass. Raises NotThere for a key."""
        try:
            yield
        except self._conflicts:
            raise
        except InvalidArgument:
            raise
        except self._errors as error:
            text = str(error)
            if key is not None and isinstance(error, FileNotFoundError) and not _REFUSED.search(text):
                raise NotThere(f"there is no {key} in {self.location}") from None
            if "416 " in (_STATUS.search(text) or [""])[0]:
                raise _BeyondTheEnd from None
            # Without the error as its cause: the URL in its text may hold a signature.
            raise StorageUnavailable(f"{self.location} cannot be used: {_reason(text)}") from None


def _client_options(scheme: str) -> Any:
    """Time-outs, and what the environment says of the connections: obstore looks there only where it is given none."""
    options = {
        "connect_timeout": f"{_CONNECT_TIMEOUT_S}s",
        "read_timeout": f"{_SILENCE_TIMEOUT_S}s",
        "timeout": f"{_REQUEST_TIMEOUT_S}s",
    }
    names = (*options, "allow_http", "allow_invalid_certificates", "proxy_url", "proxy_excludes", "user_agent")
    variables = {name: os.environ.get(f"{_ENVIRONMENT[scheme]}_{name.upper()}") for name in names}
    return options | {name: value for name, value in variables.items() if value}


def _entry(item: Any) -> Entry:
    version = item["e_tag"] or item["version"] or f"{item['last_modified'].timestamp():.6f}-{item['size']}"
    return Entry(item["path"], item["size"], version, item["last_modified"].timestamp())


def _reason(text: str) -> str:
    if _REFUSED.search(text):
        return "there is no such bucket"
    if status := _STATUS.search(text):
        return f"it answers {status[1].strip()}"
    if "timed out" in text.lower():
        return "it does not answer in time"
    return "it does not answer"


def _first_line(error: Exception) -> str:
    return str(error).partition("\n")[0]
