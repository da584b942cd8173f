"""Checks of where a command writes, before the work starts; tables on standard output."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

from ultragray.errors import InvalidArgument

SCENE_SUFFIX = ".ugr"  # the service lists no other files
_PIPE_COLUMNS = 400  # where no terminal says how wide it is, nothing is cut


def check_writable(path: Path, suffix: str | None = None) -> None:
    """Raise InvalidArgument where `path` is a folder, does not end in `suffix`, or could not be made."""
    if path.is_dir():
        raise InvalidArgument(f"output must be a file, {path} is a folder", field="output")
    if suffix is not None and path.suffix != suffix:
        raise InvalidArgument(f"output must end in {suffix}, got {path.name!r}", field="output")
    folder = path.absolute().parent
    if not folder.is_dir():
        raise InvalidArgument(f"output must lie in a folder that exists, {path.parent} does not", field="output")
    if not os.access(folder, os.W_OK):
        raise InvalidArgument(f"output must lie in a folder that can be written to, {folder} cannot", field="output")


def check_picture_folder(path: Path) -> None:
    """Raise InvalidArgument where `path` is a file, or a folder with files: pictures of two runs would mix."""
    if path.exists() and not path.is_dir():
        raise InvalidArgument(f"output must be a folder for pictures, {path} is a file", field="output")
    if path.is_dir() and next(path.iterdir(), None) is not None:
        raise InvalidArgument(f"output must be a new or empty folder, {path} holds files", field="output")


def print_table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print rows under their columns; the first column is never cut."""
    from rich.console import Console
    from rich.table import Table

    console = Console()
    if not console.is_terminal:
        console.width = _PIPE_COLUMNS
    table = Table(*columns, box=None, pad_edge=False)
    table.columns[0].no_wrap = True
    for row in rows:
        table.add_row(*row)
    console.print(table)
