"""Scenes of the service: where their files lie, their headers, pages of their names."""

from __future__ import annotations

import asyncio
import base64
import binascii
import math
import re
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import copy_context
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from ultragray.errors import InvalidArgument, SceneFileInvalid, UltragrayError
from ultragray.scene.info import SceneHeader
from ultragray_service.core.threads import in_own_thread
from ultragray_service.settings import Settings
from ultragray_service.core.scene_points import point_message
from ultragray_workers.errors import SceneNotFound, SceneTooLarge, StartupFailed, StorageUnavailable
from ultragray_workers.scenes import SceneStore
from ultragray_workers.shelves.bucket import BucketShelf
from ultragray_workers.shelves.folder import FolderShelf
from ultragray_workers.shelves.index import SceneIndex
from ultragray_workers.shelves.opening import SCENES_FOLDER
from ultragray_workers.shelves.shelf import Shelf
from ultragray_workers.storage.cache import Cache
from ultragray_workers.storage.local import FileVersion
from ultragray_workers.storage.location import Location, open_storage

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
            return FolderShelf(location / folder, open_storage(location))
        storage = open_storage(location, patience_s=PATIENCE_S)
        index = SceneIndex(storage, folder, self._settings.scene_list_max_age_s)
        return BucketShelf(index, self.cache, self._settings.working_folder / SCENES_FOLDER)

    def _buckets(self) -> Iterator[BucketShelf]:
        for shelf in (self.data, self.made):
            if isinstance(shelf, BucketShelf):
                yield shelf


# Facts about scenes, read from their files without blocking the event loop.


T = TypeVar("T")

_FOLDERS = re.compile(r"^/.*/(?=[^/]+\.ugr\b)", re.DOTALL)
DEFAULT_PAGE_SIZE = 100
MAX_PAGE_SIZE = 1000
_READ_AT_ONCE = 8  # headers of a page


@dataclass(frozen=True)
class CatalogEntry:
    """A scene of the data folder: its header, or why the file cannot be read."""

    name: str
    header: SceneHeader | None
    error: UltragrayError | None
    changed_at_s: float | None = None  # when its file was last written, time.time(); None: it lies in a bucket alone


class SceneCatalog:
    """Headers, pages of scene names, and Gaussians as points."""

    def __init__(self, store: SceneStore) -> None:
        self._store = store
        self._reading_points = asyncio.Lock()

    async def header(self, name: str) -> SceneHeader:
        """The header of a scene. Raises SceneNotFound, SceneFileInvalid; both name the field `scene`."""
        with scene_to_blame():
            cached = self._store.cached_versioned_header(name)
            return cached[1] if cached is not None else await _fetched(self._store.header, name)

    async def versioned_header(self, name: str) -> tuple[FileVersion, SceneHeader]:
        """The same, with the version of the file that it is of."""
        with scene_to_blame():
            cached = self._store.cached_versioned_header(name)
            return cached if cached is not None else await _fetched(self._store.versioned_header, name)

    async def version(self, name: str) -> FileVersion:
        """The version of the content that the file of a scene has now. Raises SceneNotFound, SceneFileInvalid."""
        with scene_to_blame():
            return await asyncio.to_thread(self._store.version, name)

    async def points(self, name: str, limit: int, fields: Sequence[str]) -> bytes:
        """At most `limit` Gaussians of a scene, as `point_message`.

        Raises SceneNotFound, SceneFileInvalid, InvalidArgument for fields that there are not.
        """
        header = await self.header(name)
        with scene_to_blame():
            path = await asyncio.to_thread(self._store.path, name)
            async with self._reading_points:  # all the Gaussians of one scene in memory are enough
                return await in_own_thread(lambda: point_message(path, header.info, limit, fields))

    async def names(self) -> list[str]:
        """The names of the scenes that the caller may see, sorted."""
        return await asyncio.to_thread(self.shown_names)

    def shown_names(self) -> list[str]:
        """Likewise. Blocks; may be called from any thread."""
        return self._store.shown_names()

    async def page(self, page_size: int, page_token: str) -> tuple[list[CatalogEntry], str]:
        """One page of scenes by name and the token of the next (empty on the last).

        Raises InvalidArgument for a page_size outside 1 to 1000 and for a token that no page gave.
        """
        chosen, next_page_token = page_of_names(await self.names(), page_size, page_token)
        at_once = asyncio.Semaphore(_READ_AT_ONCE)

        async def read(name: str) -> CatalogEntry | None:
            async with at_once:
                return await self._entry(name)

        read_entries = await asyncio.gather(*map(read, chosen))
        return [entry for entry in read_entries if entry is not None], next_page_token

    async def _entry(self, name: str) -> CatalogEntry | None:
        try:
            header = await self.header(name)
            cached = self._store.cached_versioned_header(name)
            return CatalogEntry(name, header, None, None if cached is None else cached[0].mtime_ns / 1e9)
        except SceneNotFound:  # deleted since the folder was read
            return None
        except UltragrayError as error:
            return CatalogEntry(name, None, error)


async def _fetched(read: Callable[[str], T], name: str) -> T:
    """What may have to come from a bucket first, read in a thread of its own that knows who asks."""
    context = copy_context()
    return await in_own_thread(lambda: context.run(read, name))


def page_of_names(names: list[str], page_size: int, page_token: str) -> tuple[list[str], str]:
    """The names of one page of the sorted `names`, and the token of the next page (empty on the last).

    Raises InvalidArgument for a page_size outside 1 to 1000 and for a token that no page gave.
    """
    if not 1 <= page_size <= MAX_PAGE_SIZE:
        raise InvalidArgument(
            f"page_size must be an integer from 1 to {MAX_PAGE_SIZE}, got {page_size}", field="page_size"
        )
    start = bisect_right(names, _name_of_token(page_token)) if page_token else 0
    chosen = names[start : start + page_size]
    return chosen, _token_of_name(chosen[-1]) if start + page_size < len(names) else ""


@contextmanager
def scene_to_blame() -> Iterator[None]:
    """Errors about a scene name the field `scene`, and its file without the folders of the service."""
    try:
        yield
    except (SceneNotFound, SceneFileInvalid, SceneTooLarge) as error:
        raise type(error)(_FOLDERS.sub("", error.detail), field=error.field or "scene") from error


def finite_metrics(header: SceneHeader) -> dict[str, float]:
    """The scene's metrics that are numbers (a file may claim anything)."""
    return {name: float(value) for name, value in header.info.metrics.items() if _is_number(value)}


def _is_number(value: Any) -> bool:
    try:
        return isinstance(value, (int, float)) and math.isfinite(value)
    except OverflowError:  # an integer beyond all floats
        return False


def _token_of_name(name: str) -> str:
    return base64.urlsafe_b64encode(name.encode()).decode().rstrip("=")


def _name_of_token(token: str) -> str:
    try:
        return base64.b64decode(token + "=" * (-len(token) % 4), altchars=b"-_", validate=True).decode()
    except (binascii.Error, ValueError):
        raise InvalidArgument(
            "page_token must be a next_page_token that an earlier page gave", field="page_token"
        ) from None
