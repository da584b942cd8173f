"""The files of a run that can be gone on from, as they are at one moment, however deep they lie. Free of torch."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path

from ultragray.files import TEMPORARY_SUFFIX
from ultragray_workers.jobs.files import BASELINES_NAME, CONFIG_NAME, JOURNAL_NAME

# A checkpoint: they say nothing without it, and a journal grows all the time.
_BESIDE = (JOURNAL_NAME, CONFIG_NAME, BASELINES_NAME)
_PICTURE = ".png"  # of a validation: likewise

Version = Mapping[str, int]  # the time of each file that is replaced whole, by its path within the run


def version_of(run: Path) -> Version:
    """The version of a run; empty where there is nothing to go on from."""
    found = {}
    for path in _files(run):
        if not _is_beside(path):
            with contextlib.suppress(FileNotFoundError):  # replaced or removed meanwhile
                found[path.relative_to(run).as_posix()] = path.stat().st_mtime_ns
    return found


def copy_of(run: Path, version: Version, target: Path) -> bool:
    """Puts the run into a new folder; False where it is not of this version (any more).

    Links to what is replaced whole: that stays as it is when the process of the job replaces it. What grows comes
    after it: a journal that is ahead is cut where a training goes on.
    """
    target.mkdir()
    try:
        for name in version:
            _place(target, name).hardlink_to(run / name)
        for path in _files(run):
            if _is_beside(path):
                shutil.copyfile(path, _place(target, path.relative_to(run).as_posix()))
    except FileNotFoundError:
        return False
    return version_of(run) == version


def files_in(folder: Path) -> dict[str, Path]:
    """The files of a copy by their paths within it, sorted."""
    return {path.relative_to(folder).as_posix(): path for path in sorted(_files(folder))}


def _is_beside(path: Path) -> bool:
    return path.name in _BESIDE or path.suffix == _PICTURE


def _place(target: Path, name: str) -> Path:
    path = target / name
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _files(folder: Path) -> Iterator[Path]:
    for path in folder.rglob("*"):
        if path.is_file() and not (path.name.startswith(".") and path.name.endswith(TEMPORARY_SUFFIX)):
            yield path
