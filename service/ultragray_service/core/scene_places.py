"""The places of the scenes that a service has: its data folder, and where imports and jobs put theirs."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from ultragray_service.settings import Settings
from ultragray_workers.errors import StartupFailed, StorageUnavailable
from ultragray_workers.jobs.publication import SCENES_FOLDER
from ultragray_workers.shelves.bucket import BucketShelf
from ultragray_workers.shelves.folder import FolderShelf
from ultragray_workers.shelves.index import SceneIndex
from ultragray_workers.shelves.shelf import Shelf
from ultragray_workers.storage.cache import Cache
from ultragray_workers.storage.location import Location
from ultragray_workers.storage.opening import open_storage

PATIENCE_S = 10.0  # of frames that wait for a scene


class ScenePlaces:
    """`data`, whose scenes are the operator's, and `made`, whose scenes were imported or made by jobs."""

    def __init__(self, settings: Settings) -> None:
        """Raises StartupFailed for a data folder that does not exist, ExtraMissing, InvalidArgument."""
        if isinstance(settings.data_folder, Path) and not settings.data_folder.is_dir():
            raise StartupFailed(
                f"data_folder must be an existing folder, got {str(settings.data_folder)!r}", field="data_folder"
            )
        self.cache = Cache(settings.cache, settings.max_cache_bytes)
        self._settings = settings
        self.data = self._shelf(settings.data_folder, "")
        self.made = self._shelf(settings.artifacts, SCENES_FOLDER)

    @property
    def buckets(self) -> tuple[BucketShelf, ...]:
        """Those of the two that are in a bucket."""
        return tuple(self._buckets())

    @property
    def problem(self) -> StorageUnavailable | None:
        """What keeps a list of scenes from being read; None: nothing does."""
        return next((one.index.problem for one in self.buckets if one.index.problem is not None), None)

    @property
    def stale_problem(self) -> StorageUnavailable | None:
        """The same, once it lasts so long that scenes are not served any more."""
        return next((one.index.problem for one in self.buckets if not one.index.is_usable), None)

    async def open(self) -> None:
        """Reads the lists of scenes, and follows their changes."""
        for bucket in self.buckets:
            with suppress(StorageUnavailable):  # told by health, and read as soon as it can be
                await asyncio.to_thread(bucket.index.read)
            bucket.follow()

    async def close(self) -> None:
        """Follows them no more."""
        for bucket in self.buckets:
            await asyncio.to_thread(bucket.close)

    def _shelf(self, location: Location, folder: str) -> Shelf:
        if isinstance(location, Path):
            return FolderShelf(location / folder)
        storage = open_storage(location, patience_s=PATIENCE_S)
        index = SceneIndex(storage, folder, self._settings.scene_list_max_age_s)
        return BucketShelf(index, self.cache, self._settings.working_folder / SCENES_FOLDER)

    def _buckets(self) -> Iterator[BucketShelf]:
        for shelf in (self.data, self.made):
            if isinstance(shelf, BucketShelf):
                yield shelf
