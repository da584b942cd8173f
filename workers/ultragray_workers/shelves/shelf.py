"""The methods that a folder of scenes and a bucket of scenes have in common."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path
from typing import Protocol

from ultragray.scene.info import SceneHeader


class Shelf(Protocol):
    """The scenes of one place, by names that scenes can have. Its methods may be called from any thread.

    All but `knows`, `here` and `hold` may block, and raise StorageUnavailable where a bucket does not answer.
    """

    def names(self) -> set[str]:
        """The names of all scenes."""

    def has(self, name: str) -> bool:
        """Whether there is the scene."""

    def knows(self, name: str) -> bool:
        """The same as it was found last."""

    def here(self, name: str) -> Path | None:
        """The file of the scene on this host; None where it has to be fetched first, or there is none."""

    def fetch(self, name: str) -> Path:
        """The file of the scene, on this host from now on. Raises FileNotFoundError, StorageFull."""

    def hold(self, name: str) -> AbstractContextManager[Path | None]:
        """As `here`; the file stays during the body."""

    def header(self, name: str) -> SceneHeader:
        """The description of the scene; its Gaussians are not fetched. Raises FileNotFoundError, SceneFileInvalid."""

    def bytes_of(self, name: str) -> int:
        """Of the file of a scene; 0 where there is none."""

    def sha256(self, name: str) -> str | None:
        """The hash of the file, where it is known without reading it."""

    def publish(self, file: Path, name: str) -> None:
        """Serves a file, which is not changed any more, as a scene; nothing where it is served already.

        Raises SceneExists where another scene has the name, OSError.
        """

    def remove(self, name: str) -> bool:
        """Removes the scene; False where there was none."""

    def making(self) -> AbstractContextManager[Path]:
        """A new folder in which a file is made, whose name is a token that tells other services who is at it."""

    def is_making(self, token: str) -> bool:
        """Whether whoever has the token is still alive."""

    def remove_abandoned(self) -> None:
        """Removes the folders of `making` whose services died."""
