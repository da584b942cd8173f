"""One array of numbers in a `.npy` file, mapped and not read; what is wrong with a file, in our words.

The header is checked before numpy maps the file: its own messages advise to unpickle what is no array.
"""

from __future__ import annotations

import math
from pathlib import Path
from tokenize import TokenError
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

_DAMAGED = "its .npy header is damaged or truncated"
_MAGIC, _ZIP_MAGIC = b"\x93NUMPY", b"PK\x03\x04"


def map_npy(path: Path) -> npt.NDArray[Any]:
    """The array of a `.npy` file as a read-only mapping, which cannot be larger than its file.

    Raises ValueError with the reason as a clause: no `.npy` file, an archive, truncated, or of Python objects. Raises
    OSError where the file cannot be read. Never runs code from the file.
    """
    with path.open("rb") as file:
        shape, dtype = _read_header(file)
        missing = file.tell() + math.prod(shape) * dtype.itemsize - path.stat().st_size
    if missing > 0:
        raise ValueError(f"it is truncated: {missing} bytes are missing")
    try:
        return np.asarray(np.load(path, mmap_mode="r", allow_pickle=False))
    except OverflowError:
        raise ValueError(_DAMAGED) from None  # sizes that no array has, one of them 0


def _read_header(file: BinaryIO) -> tuple[tuple[int, ...], np.dtype[Any]]:
    start = file.read(len(_MAGIC))
    if start.startswith(_ZIP_MAGIC):
        raise ValueError("it is an archive (.npz), where one array (.npy) is expected")
    if start != _MAGIC:
        raise ValueError("it does not start as a .npy file does")
    file.seek(0)
    try:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
    except (ValueError, TypeError, SyntaxError, TokenError, RecursionError):
        raise ValueError(_DAMAGED) from None
    if dtype.hasobject:
        raise ValueError("it holds Python objects, where numbers are expected")
    if any(size < 0 for size in shape):
        raise ValueError(_DAMAGED)
    return shape, dtype
