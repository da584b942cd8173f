"""A little memory that the service shares with one of its worker processes: written and read without a message."""

from __future__ import annotations

import mmap
import os

import numpy as np

from ultragray.limits import Flag

_TAKEN, _GIVEN_UP, _FIELDS = range(3)


class Board:
    """Numbers of a worker's tasks, which both sides count from 1: the last one taken up, the last to be given up."""

    def __init__(self, descriptor: int) -> None:
        self._memory = mmap.mmap(descriptor, _FIELDS * np.dtype(np.int64).itemsize)
        numbers = np.frombuffer(self._memory, np.int64)
        self.taken: Flag = numbers[_TAKEN : _TAKEN + 1]  # the worker writes it
        self.given_up: Flag = numbers[_GIVEN_UP : _GIVEN_UP + 1]  # the service writes it; kernels look at it

    def close(self) -> None:
        """Gives the memory back; nothing is written or read any more."""
        del self.taken, self.given_up
        self._memory.close()

    @staticmethod
    def new_memory() -> int:
        """The descriptor of memory for one board."""
        descriptor = os.memfd_create("ultragray-board")
        os.ftruncate(descriptor, _FIELDS * np.dtype(np.int64).itemsize)
        return descriptor
