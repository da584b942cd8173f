"""The log of a job as it grows: whole lines, from a place in the file on."""

from __future__ import annotations

from ultragray_workers.jobs.files import Log

DEFAULT_LOG_BYTES, MAX_LOG_BYTES = 65536, 2**20  # of the log's end, given at once
TAIL_BYTES = 8192  # of the log, for a watcher who names no place
_STEP_BYTES = 65536  # at most, of one read


class GrowingLog:
    """Reads a log step by step; one that does not exist yet is empty."""

    def __init__(self, log: Log, offset: int | None = None) -> None:
        """`offset`: the byte of the log to go on from; None: the last lines that are there at the first read."""
        self._log = log
        self._offset = offset
        self.has_more = False  # whether there may be more to read at once

    @property
    def offset(self) -> int:
        return self._offset or 0

    def read(self) -> str:
        """The next lines that are whole; a line longer than a step comes in pieces.

        A log that became shorter was begun again, and is read from its start. Raises StorageUnavailable.
        """
        self._offset = self._begin()
        added = self._log.read(self._offset, _STEP_BYTES)
        self.has_more = len(added) == _STEP_BYTES
        end = added.rfind(b"\n") + 1
        if not end and self.has_more:
            end = len(added)
        self._offset += end
        return added[:end].decode("utf-8", "replace")

    def _begin(self) -> int:
        size = self._log.size()
        if self._offset is not None:
            return self._offset if self._offset <= size else 0
        begin = max(0, size - TAIL_BYTES)
        return begin and begin + self._log.read(begin, TAIL_BYTES).find(b"\n") + 1
