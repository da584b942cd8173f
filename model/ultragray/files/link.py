"""A second name for a file that never changes."""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path

from ultragray.files.atomic import atomic_path, sync


def link_or_copy(source: Path, target: Path) -> None:
    """Makes `target` the same file as `source`, or a whole copy where that cannot be; an existing target stays.

    What is there then survives a loss of power. Raises OSError.
    """
    with suppress(FileExistsError):
        try:
            os.link(source.resolve(), target)
        except FileExistsError:
            raise
        except OSError:  # another file system, or one without links
            _copy(source, target)
    sync(target.parent)


def _copy(source: Path, target: Path) -> None:
    with atomic_path(target) as temporary:
        shutil.copyfile(source, temporary)
        sync(temporary)
        try:
            os.link(temporary, target)  # unlike a rename, never over what appeared meanwhile
        except FileExistsError:
            raise
        except OSError:
            if target.exists():
                raise FileExistsError from None
