"""A second name for a file that never changes."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from ultragray.files import atomic_path


def link_or_copy(source: Path, target: Path) -> None:
    """Makes `target` the same file as `source`, or a whole copy where that cannot be; an existing target stays.

    Raises OSError.
    """
    source = source.resolve()
    try:
        os.link(source, target)
    except FileExistsError:
        return
    except OSError:  # another file system, or one without links
        with atomic_path(target) as temporary:
            shutil.copyfile(source, temporary)
