"""The lines between a worker and its job's process: JSON, one message a line, over a pipe in either direction."""

from __future__ import annotations

import json
import os
import select
from collections.abc import Iterator
from typing import Any

_CHUNK_BYTES = 1 << 16


class Channel:
    """One end: a pipe that is read, and one that is written."""

    def __init__(self, reading: int, writing: int) -> None:
        self._reading, self._writing = reading, writing
        self._begun = b""  # of a line
        self.is_open = True  # the other end may still say something

    def send(self, message: dict[str, Any]) -> None:
        """Says something; nothing where the other end has gone."""
        data = json.dumps(message).encode() + b"\n"
        try:
            while data:
                data = data[os.write(self._writing, data) :]
        except BrokenPipeError:
            self.is_open = False

    def receive(self, timeout_s: float) -> Iterator[dict[str, Any]]:
        """What the other end has said; waits until it says something, or for so long."""
        if not self.is_open or not select.select([self._reading], [], [], timeout_s)[0]:
            return
        data = os.read(self._reading, _CHUNK_BYTES)
        self.is_open = bool(data)
        *lines, self._begun = (self._begun + data).split(b"\n")
        for line in lines:
            yield json.loads(line)

    def close(self) -> None:
        """Ends this end."""
        self.is_open = False
        for descriptor in (self._reading, self._writing):
            os.close(descriptor)


def channel() -> tuple[Channel, tuple[int, int]]:
    """An end for this process, and the descriptors for the end of another one, which inherits them."""
    there_reads, here_writes = os.pipe()
    here_reads, there_writes = os.pipe()
    return Channel(here_reads, here_writes), (there_reads, there_writes)
