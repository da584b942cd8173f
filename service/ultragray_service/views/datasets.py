"""What the console shows of a dataset: the poses and the frames, one by one."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from pathlib import Path

from ultragray.errors import ArtifactNotFound, DatasetNotFound, UltragrayError
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.datasets.view import POSES_NAME
from ultragray_workers.helpers.picture_stack import read_picture
from ultragray_workers.pool.process.encoding import encode_image
from ultragray_workers.pool.types import Encoding

from ..settings import Settings
from .prepared import PreparedFolders

FOLDER = "dataset-views"  # of the artifact folder


class DatasetViews:
    """Laid out at the first look, and kept by the content of the dataset."""

    def __init__(self, store: DatasetStore, settings: Settings, turn: asyncio.Lock) -> None:
        self._store = store
        self._artifacts = settings.artifacts
        self.folders = PreparedFolders(
            settings.artifacts / FOLDER, "datasets.view", "laying out the frames of the dataset", settings, turn
        )

    async def key(self, name: str) -> str:
        """Names the content of a dataset. Raises DatasetNotFound, DatasetInvalid."""
        return (await asyncio.to_thread(self._store.get, name)).sha256

    async def poses_json(self, name: str) -> bytes:
        """`train` and `val`, each a list of poses, 16 numbers row by row, mm. Raises DatasetNotFound, DatasetInvalid,
        MemoryExceeded, StorageFull, DeadlineExceeded, Draining."""
        folder = await self._folder(name)
        try:
            return await asyncio.to_thread((folder / POSES_NAME).read_bytes)
        except FileNotFoundError:
            raise DatasetNotFound(f"the dataset {name!r} has been deleted", field="dataset") from None

    async def frame_png(self, name: str, part: str, index: int) -> bytes:
        """One frame of `part` (train or val), PNG. Raises as `poses_json`; DatasetNotFound also for no such frame."""
        folder = await self._folder(name)
        return await asyncio.to_thread(_frame_png, folder, name, part, index)

    async def _folder(self, name: str) -> Path:
        request = {"artifact_folder": str(self._artifacts), "dataset": name}
        try:
            return await self.folders.path(await self.key(name), request)
        except ArtifactNotFound:
            raise DatasetNotFound(f"the dataset {name!r} has been deleted", field="dataset") from None


def datasets_by_content(store: DatasetStore) -> dict[str, str]:
    """The name of a dataset by its SHA-256; blocks. Those whose manifest is damaged are left out."""
    found: dict[str, str] = {}
    for name in store.names():
        with suppress(UltragrayError):
            found.setdefault(store.get(name).sha256, name)
    return found


def _frame_png(folder: Path, name: str, part: str, index: int) -> bytes:
    picture = read_picture(folder, part, index)
    if picture is None:
        raise DatasetNotFound(f"the dataset {name!r} has no frame {index} in its part {part}", field="index")
    return encode_image(picture, Encoding.PNG).tobytes()
