"""The poses and the frames of a dataset, one by one."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from pathlib import Path

from ultragray.contract import described
from ultragray_service.core.helper_processes import HelperProcesses
from ultragray_service.settings import Settings
from ultragray_service.views.prepared import Prepared
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.errors import ArtifactNotFound, DatasetNotFound
from ultragray_workers.helpers.dataset_view import POSES_NAME, lay_out


@dataclass(frozen=True)
class DatasetPoses:
    """The poses of a dataset."""

    train: list[list[float]] = described("16 numbers each, row by row, mm.")
    val: list[list[float]] = described("Of the held-out frames.")


class DatasetViews(Prepared):
    """Laid out at the first look, and kept by the content of the dataset."""

    name, what, fill = "dataset-views", "laying out the frames of the dataset", staticmethod(lay_out)

    def __init__(self, store: DatasetStore, settings: Settings, processes: HelperProcesses) -> None:
        super().__init__(settings, processes)
        self._store = store

    async def key(self, name: str) -> str:
        """The content of a dataset. Raises DatasetNotFound, DatasetInvalid."""
        return (await asyncio.to_thread(self._store.get, name)).sha256

    async def poses_json(self, name: str) -> bytes:
        """The JSON of DatasetPoses.

        Raises DatasetNotFound, DatasetInvalid, MemoryExceeded, StorageFull, DeadlineExceeded, Draining.
        """
        folder = await self._laid_out(name)
        try:
            return await asyncio.to_thread((folder / POSES_NAME).read_bytes)
        except FileNotFoundError:
            raise _deleted(name) from None

    async def frame_png(self, name: str, part: str, index: int) -> bytes:
        """One frame of `part` (train or val). Raises as `poses_json`; DatasetNotFound also for no such frame."""
        key = (await self._laid_out(name)).name
        if (png := await self.picture_png(key, index, part)) is None:
            raise DatasetNotFound(f"the dataset {name!r} has no frame {index} in its part {part}", field="index")
        return png

    async def _laid_out(self, name: str) -> Path:
        try:
            return await self.path(await self.key(name), dataset=name)
        except ArtifactNotFound:
            raise _deleted(name) from None


def _deleted(name: str) -> DatasetNotFound:
    return DatasetNotFound(f"the dataset {name!r} has been deleted", field="dataset")
