"""Where a command writes, checked before the work starts."""

from __future__ import annotations

from pathlib import Path

from ultragray.errors import InvalidArgument


def check_writable(path: Path) -> None:
    """Raises InvalidArgument where `path` is a folder, or the folder it would lie in is missing."""
    if path.is_dir():
        raise InvalidArgument(f"output must be a file, {path} is a folder", field="output")
    if not path.absolute().parent.is_dir():
        raise InvalidArgument(f"output must lie in a folder that exists, {path.parent} does not", field="output")
