"""Where a command writes: checked before the work starts. What exists is replaced only with --force."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING

from ultragray.errors import InvalidArgument

if TYPE_CHECKING:
    from rich.console import Console

SCENE_SUFFIX = ".ugr"  # the service lists no other files
_PIPE_COLUMNS = 400  # where no terminal says how wide it is, nothing is cut
OR_A_FOLDER = ", or be a folder for PNGs (a name without an ending)"
_PICTURES = (".png", ".jpg", ".jpeg")
_SIMILAR = {".hdf5": ".h5", ".hdf": ".h5", ".mha": ".igs.mha", ".zarr": ".zarr.zip", ".dicom": ".dcm", ".jpeg": ".jpg"}


def check_file(path: Path, suffixes: Sequence[str] = (), *, force: bool) -> None:
    """Raise InvalidArgument where a file cannot be written to `path`, or may not.

    That is: the name ends in none of `suffixes` (none given: any will do), `path` is a folder or exists without
    `force`, or its folder is not there or cannot be written to.
    """
    if path.is_dir():
        raise InvalidArgument(f"output must be a file, {path} is a folder", field="output")
    check_ending(path, suffixes)
    folder = path.absolute().parent
    if not folder.is_dir():
        raise InvalidArgument(f"output must lie in a folder that exists, {path.parent} does not", field="output")
    if not os.access(folder, os.W_OK):
        raise InvalidArgument(f"output must lie in a folder that can be written to, {folder} cannot", field="output")
    if path.exists() and not force:
        raise InvalidArgument(f"{path} exists: --force replaces it", field="output")


def check_folder(path: Path, *, force: bool) -> None:
    """Raise InvalidArgument where `path` is a file, or without `force` a folder that holds something."""
    if path.exists() and not path.is_dir():
        raise InvalidArgument(f"output must be a folder, {path} is a file", field="output")
    if path.is_dir() and not force and next(path.iterdir(), None) is not None:
        raise InvalidArgument(
            f"output must be a new or empty folder, {path} holds files: --force writes among them", field="output"
        )


def check_ending(path: Path, suffixes: Sequence[str], *, otherwise: str = "") -> None:
    """Raise InvalidArgument where a name ends in none of `suffixes`, with the one that was perhaps meant.

    `otherwise`: what the output may be instead, for the message.
    """
    if suffixes and not path.name.endswith(tuple(suffixes)):
        given = path.suffix.lower()
        similar = _SIMILAR.get(given)
        near = [similar] if similar in suffixes else get_close_matches(given, suffixes, n=1, cutoff=0.7)
        perhaps = f"; did you mean {near[0]}?" if near and len(suffixes) > 1 and given not in _PICTURES else ""
        *others, last = suffixes
        expected = f"{', '.join(others)} or {last}" if others else last
        raise InvalidArgument(f"output must end in {expected}{otherwise}, got {path.name!r}{perhaps}", field="output")


def is_folder_name(path: Path) -> bool:
    """Whether a name that no format claims stands for a folder: it has no ending, or it is one already."""
    return path.is_dir() or not path.suffix


def print_table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print rows under their columns; the first column is never cut."""
    from rich.markup import escape
    from rich.table import Table

    table = Table(*columns, box=None, pad_edge=False)
    table.columns[0].no_wrap = True
    for row in rows:
        table.add_row(*map(escape, row))  # a reason or a name may hold brackets
    wide_console().print(table)


def wide_console() -> Console:
    """Standard output; what is not a terminal is so wide that nothing is cut."""
    from rich.console import Console

    console = Console()
    if not console.is_terminal:
        console.width = _PIPE_COLUMNS
    return console
