"""What the console shows of a dataset: the poses and the frames, one by one."""

from __future__ import annotations

import asyncio
from pathlib import Path

from ultragray.errors import DatasetNotFound
from ultragray_workers.dataset_store import DatasetStore
from ultragray_workers.dataset_view import POSES_NAME
from ultragray_workers.encoding import encode_image
from ultragray_workers.picture_stack import SUFFIX, read_picture
from ultragray_workers.types import Encoding

from .prepared import PreparedFolders
from .settings import Settings

FOLDER = "dataset-views"  # of the artifact folder


class DatasetViews:
    """Laid out at the first look, and kept by the content of the dataset."""

    def __init__(self, store: DatasetStore, settings: Settings) -> None:
        self._store = store
        self._artifacts = settings.artifacts
        self.folders = PreparedFolders(
            settings.artifacts / FOLDER, "dataset_view", "laying out the frames of the dataset", settings
        )

    async def poses_json(self, name: str) -> bytes:
        """`train` and `val`, each a list of poses, 16 numbers row by row, mm. Raises DatasetNotFound, DatasetInvalid,
        MemoryExceeded."""
        folder = await self._folder(name)
        return await asyncio.to_thread((folder / POSES_NAME).read_bytes)

    async def frame_png(self, name: str, part: str, index: int) -> bytes:
        """One frame of `part` (train or val), PNG. Raises as `poses_json`; DatasetNotFound also for no such frame."""
        folder = await self._folder(name)
        return await asyncio.to_thread(_frame_png, folder / f"{part}{SUFFIX}", name, part, index)

    async def _folder(self, name: str) -> Path:
        record = await asyncio.to_thread(self._store.get, name)
        request = {"artifact_folder": str(self._artifacts), "dataset": name}
        return await self.folders.path(record.sha256, request)


def _frame_png(stack: Path, name: str, part: str, index: int) -> bytes:
    picture = read_picture(stack, index)
    if picture is None:
        raise DatasetNotFound(f"the dataset {name!r} has no frame {index} in its part {part}", field="index")
    return encode_image(picture, Encoding.PNG).tobytes()
