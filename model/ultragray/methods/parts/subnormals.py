"""Arithmetic without subnormal numbers, those below 1.2e-38: a CPU takes a hundred times as long for each.

A beam that fades along its scan line, and the gradients that go back along it, soon consist of them.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

T = TypeVar("T")


def without_subnormals(work: Callable[[], T]) -> T:
    """What `work` returns, or raises, with subnormal numbers taken for 0 by all threads of torch that it uses.

    The setting belongs to a thread, and the helpers of torch inherit it from the thread that they are made for. So
    `work` runs in a thread of its own, which gets new ones. (Graphics processors take no longer for subnormals.)
    """
    with ThreadPoolExecutor(1, "no-subnormals", torch.set_flush_denormal, (True,)) as thread:
        return thread.submit(work).result()
