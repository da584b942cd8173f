"""Where datasets are: by name, each a manifest, the files that were sent, and a contact sheet. Free of torch."""

from __future__ import annotations

import contextlib
import errno
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

from ultragray.files import sync
from ultragray_workers.claims import is_claimed, out_of_sight

MANIFEST_NAME, FILES_NAME, CONTACT_SHEET_NAME = "dataset.json", "files", "contact_sheet.png"


class Shelf(Protocol):
    """Keeps datasets; a dataset appears and goes whole. Every method blocks. Names are those that datasets may have."""

    def names(self) -> list[str]:
        """The names of all datasets."""

    def manifest(self, name: str) -> str | None:
        """The manifest of a dataset; None where there is none of that name."""

    def contact_sheet(self, name: str) -> Path:
        """The PNG of a dataset that is there, on this host."""

    def files(self, name: str) -> contextlib.AbstractContextManager[Path]:
        """The folder of a dataset's files on this host; it stays during the body."""

    def put(self, folder: Path, name: str) -> bool:
        """Make a complete folder the dataset `name`; False where there is one already."""

    def without(self, name: str) -> contextlib.AbstractContextManager[bool]:
        """Nobody finds the dataset during the body; then it is removed, or put back where the body raises.

        Gives whether it was there. Where its name was taken meanwhile, it is not put back.
        """

    def is_claimed(self, token: str) -> bool:
        """Whether a service that lives makes a dataset in the claimed folder of that name."""

    def claimed(self, token: str) -> contextlib.AbstractContextManager[None]:
        """Tells the services of other hosts, too, that the claimed folder of that name has a living maker."""


class FolderShelf:
    """Datasets as folders beside each other, which all services and workers see."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def names(self) -> list[str]:
        """As `Shelf`."""
        try:
            entries = list(self._folder.iterdir())
        except (FileNotFoundError, NotADirectoryError):
            return []
        return [entry.name for entry in entries if (entry / MANIFEST_NAME).is_file()]

    def manifest(self, name: str) -> str | None:
        """As `Shelf`."""
        try:
            return (self._folder / name / MANIFEST_NAME).read_text(encoding="utf-8")
        except (FileNotFoundError, NotADirectoryError):
            return None

    def contact_sheet(self, name: str) -> Path:
        """As `Shelf`."""
        return self._folder / name / CONTACT_SHEET_NAME

    @contextlib.contextmanager
    def files(self, name: str) -> Iterator[Path]:
        """As `Shelf`."""
        yield self._folder / name / FILES_NAME

    def put(self, folder: Path, name: str) -> bool:
        """As `Shelf`, by one rename."""
        try:
            folder.rename(self._folder / name)
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
            return False
        sync(self._folder)
        return True

    @contextlib.contextmanager
    def without(self, name: str) -> Iterator[bool]:
        """As `Shelf`."""
        with out_of_sight(self._folder / name) as found:
            yield found
        if found:
            sync(self._folder)

    def is_claimed(self, token: str) -> bool:
        """As `Shelf`."""
        return is_claimed(self._folder / token)

    def claimed(self, token: str) -> contextlib.AbstractContextManager[None]:
        """As `Shelf`: the folder itself tells it."""
        return contextlib.nullcontext()
