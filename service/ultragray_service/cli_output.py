"""Where a command writes, checked before the work starts."""

from __future__ import annotations

import os
from pathlib import Path

from ultragray.errors import InvalidArgument


def check_writable(path: Path) -> None:
    """Raises InvalidArgument where `path` is a folder, or the folder it would lie in is missing or read-only."""
    if path.is_dir():
        raise InvalidArgument(f"output must be a file, {path} is a folder", field="output")
    folder = path.absolute().parent
    if not folder.is_dir():
        raise InvalidArgument(f"output must lie in a folder that exists, {path.parent} does not", field="output")
    if not os.access(folder, os.W_OK):
        raise InvalidArgument(f"output must lie in a folder that can be written to, {folder} cannot", field="output")
