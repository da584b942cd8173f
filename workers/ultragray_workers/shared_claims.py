"""Claims that the hosts of a storage see: who makes something says so again and again, as long as its process lives.

claims/TOKEN   written every REFRESH_S seconds; the clock is the storage's
"""

from __future__ import annotations

import contextlib
import secrets
import threading
from collections.abc import Iterator

from ultragray_workers.errors import StorageUnavailable
from ultragray_workers.storage.storage import Storage

PREFIX = "claims"
REFRESH_S, DEAD_AFTER_S = 10.0, 60.0


class SharedClaims:
    """The claims of a storage. Its methods block."""

    def __init__(self, storage: Storage) -> None:
        self._storage = storage

    @contextlib.contextmanager
    def claimed(self, token: str) -> Iterator[None]:
        """Others find the token claimed during the body. Enter and leave it in any threads.

        Raises StorageUnavailable.
        """
        key = f"{PREFIX}/{token}"
        self._write(key)
        ended = threading.Event()

        def refresh() -> None:
            while not ended.wait(REFRESH_S):
                with contextlib.suppress(StorageUnavailable):  # others ask the same storage
                    self._write(key)

        thread = threading.Thread(target=refresh, name="claim", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()
            with contextlib.suppress(StorageUnavailable):
                self._storage.delete(key)

    def is_claimed(self, token: str) -> bool:
        """Whether who claimed the token is alive. Raises StorageUnavailable."""
        claim = self._storage.entry(f"{PREFIX}/{token}")
        if claim is None:
            return False
        probe = f"{PREFIX}/now-{secrets.token_hex(8)}"
        self._write(probe)
        try:
            now = self._storage.entry(probe)
        finally:
            self._storage.delete(probe)
        return now is None or now.modified - claim.modified < DEAD_AFTER_S

    def _write(self, key: str) -> None:
        self._storage.write(key, secrets.token_hex(8).encode())
