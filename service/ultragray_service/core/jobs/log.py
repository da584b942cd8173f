"""The log of a job as it grows: whole lines, from a place in the file on."""

from __future__ import annotations

import os
from pathlib import Path

DEFAULT_LOG_BYTES, MAX_LOG_BYTES = 65536, 2**20  # of the log's end, given at once
TAIL_BYTES = 8192  # of the log, for a watcher who names no place
_STEP_BYTES = 65536  # at most, of one read


class GrowingLog:
    """Reads a log file step by step; a file that does not exist yet is empty."""

    def __init__(self, path: Path, offset: int | None = None) -> None:
        """`offset`: the byte of the file to go on from; None: the last lines that are there at the first read."""
        self._path = path
        self._offset = offset
        self.has_more = False  # whether there may be more to read at once

    @property
    def offset(self) -> int:
        """The byte of the file up to which it was read."""
        return self._offset or 0

    def read(self) -> str:
        """The next lines that are whole; a line longer than a step comes in pieces.

        A file that became shorter was begun again, and is read from its start.
        """
        self.has_more = False
        try:
            with self._path.open("rb") as file:
                self._offset = self._begin(file.fileno())
                file.seek(self._offset)
                added = file.read(_STEP_BYTES)
        except FileNotFoundError:
            self._offset = 0
            return ""
        self.has_more = len(added) == _STEP_BYTES
        end = added.rfind(b"\n") + 1
        if not end and self.has_more:
            end = len(added)
        self._offset += end
        return added[:end].decode("utf-8", "replace")

    def _begin(self, file: int) -> int:
        size = os.fstat(file).st_size
        if self._offset is not None:
            return self._offset if self._offset <= size else 0
        begin = max(0, size - TAIL_BYTES)
        return begin and begin + os.pread(file, TAIL_BYTES, begin).find(b"\n") + 1
