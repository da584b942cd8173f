"""The log of a job as it grows: whole lines, from a place in the file on."""

from __future__ import annotations

import os
from pathlib import Path

DEFAULT_LOG_BYTES, MAX_LOG_BYTES = 65536, 2**20  # of the log's end, given at once
TAIL_BYTES = 8192  # of the log, for a watcher who comes late
_STEP_BYTES = 65536  # of a log that grows faster, only the end is given


class GrowingLog:
    """Reads what was added to a log file since the last time; a file that does not exist yet is empty."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset: int | None = None  # None: nothing was read yet

    def read(self) -> str:
        """The lines that are new and whole, at first the last ones of the file.

        Where more was added than is read at a time, the oldest of it is left out. A file that became shorter was begun
        again, and is read from its start.
        """
        try:
            with self._path.open("rb") as file:
                size = os.fstat(file.fileno()).st_size
                begin = 0 if self._offset is None or self._offset > size else self._offset
                limit = TAIL_BYTES if self._offset is None else _STEP_BYTES
                left_out = size - begin > limit
                begin = max(begin, size - limit)
                file.seek(begin)
                added = file.read(size - begin)
        except FileNotFoundError:
            return ""
        end = added.rfind(b"\n") + 1
        if not end and not left_out:
            self._offset = begin
            return ""
        whole = added[:end]
        self._offset = begin + end
        if left_out:  # from the first line that is whole
            whole = whole[whole.find(b"\n") + 1 :]
        return whole.decode("utf-8", "replace")
