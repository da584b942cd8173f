"""Scenes of the service: where their files lie, their headers, and what all front doors tell of them."""

from __future__ import annotations

import asyncio
import base64
import binascii
import json
import re
from bisect import bisect_right
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from ultragray.contract import described, made_of
from ultragray.errors import InvalidArgument, SceneFileInvalid, UltragrayError
from ultragray.geometry.probe import ElevationBeam, Probe
from ultragray.rendering.outputs import OUTPUT_SCHEMA, OUTPUTS
from ultragray.scene.confidence import read_model
from ultragray.scene.info import SceneHeader
from ultragray.scene.modes import Motion
from ultragray_service.access.owners import Owners
from ultragray_service.access.principals import iso_time
from ultragray_service.core.life import Life
from ultragray_service.core.poses import PoseInBothForms, Position
from ultragray_service.core.scene_points import point_message
from ultragray_service.core.threads import in_own_thread
from ultragray_service.errors import Refusal
from ultragray_service.settings import Settings
from ultragray_workers.errors import SceneNotFound, SceneTooLarge, StartupFailed, StorageUnavailable
from ultragray_workers.jobs.owners import Kind, Ownership
from ultragray_workers.pool.pool import RenderPool
from ultragray_workers.scene_names import base_name
from ultragray_workers.scene_shelf import SCENES_FOLDER, SceneShelf
from ultragray_workers.scenes import SceneStore
from ultragray_workers.storage.cache import Cache
from ultragray_workers.storage.local import FileVersion
from ultragray_workers.storage.location import Location, open_storage

PATIENCE_S = 10.0  # of frames that wait for a scene


class ScenePlaces(Collector):
    """`data`, whose scenes are the operator's, and `artifacts`, whose scenes were imported or made by jobs."""

    def __init__(self, settings: Settings) -> None:
        if isinstance(settings.data_folder, Path) and not settings.data_folder.is_dir():
            raise StartupFailed(
                f"data_folder must be an existing folder, got {str(settings.data_folder)!r}", field="data_folder"
            )
        self.cache = Cache(settings.cache, settings.max_cache_bytes)
        self._settings = settings
        self.data = self._shelf(settings.data_folder, "")
        self.artifacts = self._shelf(settings.artifacts, SCENES_FOLDER)
        self._shelves = (self.data, self.artifacts)

    @property
    def problem(self) -> StorageUnavailable | None:
        return next((one.problem for one in self._shelves if one.problem is not None), None)

    @property
    def stale_problem(self) -> StorageUnavailable | None:
        """The same, once it lasts so long that scenes are not served any more."""
        return next((one.problem for one in self._shelves if not one.is_usable), None)

    def collect(self) -> Iterator[Metric]:
        far, counts = [one for one in self._shelves if not one.is_near], self.cache.counts
        counter, gauge = CounterMetricFamily, GaugeMetricFamily
        yield counter("ultragray_scene_cache_hits", "Requests whose scene was cached.", counts.hits)
        yield counter("ultragray_scene_cache_misses", "Scenes that were fetched from a bucket.", counts.misses)
        yield counter("ultragray_scene_cache_fetched_bytes", "Bytes of those.", counts.fetched_bytes)
        yield counter("ultragray_scene_cache_fetch_seconds", "Time that their fetches took in all.", counts.fetch_s)
        cache_bytes = self.cache.held_bytes() if far else 0
        yield gauge("ultragray_scene_cache_bytes", "Bytes that the cache of this host holds.", cache_bytes)
        errors = sum(one.unavailable_total for one in far)
        yield counter("ultragray_scene_list_errors", "Times that a bucket did not tell its scenes.", errors)
        age = max((one.age_s for one in far), default=0.0)
        yield gauge("ultragray_scene_list_age_seconds", "Age of the oldest list of the scenes of a bucket.", age)

    async def open(self) -> None:
        for shelf in self._shelves:
            with suppress(StorageUnavailable):  # told by health, and read as soon as it can be
                await asyncio.to_thread(shelf.follow)

    async def close(self) -> None:
        for shelf in self._shelves:
            await asyncio.to_thread(shelf.close)

    def _shelf(self, location: Location, folder: str) -> SceneShelf:
        return SceneShelf(
            open_storage(location, patience_s=PATIENCE_S),
            folder,
            cache=self.cache,
            working_folder=self._settings.working_folder / SCENES_FOLDER,
            longest_stale_s=self._settings.scene_list_max_age_s,
        )


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
    def __init__(self, store: SceneStore) -> None:
        self._store = store
        self._reading_points = asyncio.Lock()

    async def header(self, name: str) -> SceneHeader:
        """The header of a scene. Raises SceneNotFound, SceneFileInvalid; both name the field `scene`."""
        with scene_to_blame():
            cached = self._store.cached_versioned_header(name)
            return cached[1] if cached is not None else await in_own_thread(partial(self._store.header, name))

    async def versioned_header(self, name: str) -> tuple[FileVersion, SceneHeader]:
        with scene_to_blame():
            cached = self._store.cached_versioned_header(name)
            return cached if cached is not None else await in_own_thread(partial(self._store.versioned_header, name))

    async def version(self, name: str) -> FileVersion:
        with scene_to_blame():
            return await asyncio.to_thread(self._store.version, name)

    async def points(self, name: str, limit: int, fields: Sequence[str]) -> bytes:
        header = await self.header(name)
        with scene_to_blame():
            path = await asyncio.to_thread(self._store.path, name)
            async with self._reading_points:  # all the Gaussians of one scene in memory are enough
                return await in_own_thread(lambda: point_message(path, header.info, limit, fields))

    async def names(self) -> list[str]:
        return await asyncio.to_thread(self.shown_names)

    def shown_names(self) -> list[str]:
        """Likewise. Blocks; may be called from any thread."""
        return self._store.shown_names()

    async def page(self, page_size: int, page_token: str) -> tuple[list[CatalogEntry], str]:
        """One page by name, and the token of the next (empty on the last). Raises InvalidArgument."""
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


def page_of_names(names: list[str], page_size: int, page_token: str) -> tuple[list[str], str]:
    """The names of one page of the sorted `names`, and the token of the next (empty on the last)."""
    if not 1 <= page_size <= MAX_PAGE_SIZE:
        raise InvalidArgument(
            f"page_size must be an integer from 1 to {MAX_PAGE_SIZE}, got {page_size}", field="page_size"
        )
    start = 0
    if page_token:
        try:
            after = base64.b64decode(page_token + "=" * (-len(page_token) % 4), altchars=b"-_", validate=True)
            start = bisect_right(names, after.decode())
        except (binascii.Error, ValueError):
            raise InvalidArgument(
                "page_token must be a next_page_token that an earlier page gave", field="page_token"
            ) from None
    chosen = names[start : start + page_size]
    is_last = start + page_size >= len(names)
    return chosen, "" if is_last else base64.urlsafe_b64encode(chosen[-1].encode()).decode().rstrip("=")


@contextmanager
def scene_to_blame() -> Iterator[None]:
    """Errors about a scene name the field `scene`, and its file without the folders of the service."""
    try:
        yield
    except (SceneNotFound, SceneFileInvalid, SceneTooLarge) as error:
        raise type(error)(_FOLDERS.sub("", error.detail), field=error.field or "scene") from error


@dataclass(frozen=True)
class SceneEntry:
    """A scene in the list. A file that cannot be read has `error`, and null for what is in the file."""

    name: str
    loaded: bool = described("By at least one render process.")
    removable: bool = described("Whether it may be deleted: scenes of the data folder may not.")
    gaussian_count: int | None = None
    image_height: int | None = None
    image_width: int | None = None
    file_bytes: int | None = None
    error: Refusal | None = None
    owner: str | None = described("Who imported or trained it; null: nobody.", None)
    private: bool = described("Whether others may not see it.", False)
    probe_kind: str | None = described("Of the probe it was trained with, such as convex; null: not known.", None)
    metrics: dict[str, float] = described("Of the training, on held-out frames.", factory=dict)
    changed_at: str | None = described("When its file was last written, ISO 8601, UTC; null: not known.", None)


@dataclass(frozen=True)
class ScenePage:
    """One page of scenes by name."""

    scenes: list[SceneEntry]
    next_page_token: str = described("Empty on the last page.")


@dataclass(frozen=True)
class Bounds:
    """A box in the scene frame, mm."""

    min_mm: Position
    max_mm: Position


@dataclass(frozen=True)
class TrainingPoses:
    """The poses that the scene has seen; frames far from them extrapolate. Where there are none, all else is null."""

    count: int
    position_min_mm: Position | None = described("Of the probe's origin.", None)
    position_max_mm: Position | None = None
    first: PoseInBothForms | None = None
    middle: PoseInBothForms | None = None
    last: PoseInBothForms | None = None

    @classmethod
    def of(cls, header: SceneHeader) -> TrainingPoses:
        poses = header.training_poses
        if not len(poses):
            return cls(count=0)
        positions = poses[:, :3, 3]
        return cls(
            count=len(poses),
            position_min_mm=Position.of(positions.min(axis=0)),
            position_max_mm=Position.of(positions.max(axis=0)),
            first=PoseInBothForms.of(poses[0]),
            middle=PoseInBothForms.of(poses[len(poses) // 2]),
            last=PoseInBothForms.of(poses[-1]),
        )


@dataclass(frozen=True)
class ConfidenceFit:
    """How well a scene knows the confidence of its frames."""

    error: float = described("Mean absolute error of the confidence on the views it was fitted on.")
    fitted_on: int = described("How many those are.")


@dataclass(frozen=True, kw_only=True)
class Scene:
    """All that a scene says about itself; null where it is unknown."""

    name: str
    loaded: bool = described("By at least one render process.")
    loaded_processes: int = described("How many render processes hold it.")
    file_bytes: int
    gaussian_count: int
    sh_degree: int
    intensity: str
    centre_mm: Position
    bounds: Bounds = described("Of the Gaussians' means.")
    probe: Probe | None = described("The one it was trained with.")
    image_height: int | None
    image_width: int | None
    training_poses: TrainingPoses
    metrics: dict[str, float]
    dataset_name: str | None
    dataset_sha256: str | None
    outputs: list[str] = described("What can be rendered of it.", schema={"items": OUTPUT_SCHEMA})
    label_names: dict[int, str] = described("What the values of the output labels mean; empty: it has none.")
    beam: ElevationBeam | None = described("Of the frames it was trained on; null: they are taken for planes.")
    confidence: ConfidenceFit | None = described("null: the scene cannot tell the confidence of its frames.")
    speckle: bool = described("Whether its frames can have natural speckle.")
    motion: Motion | None = described("Modes by which its tissue moves; null: it is still.")
    owner: str | None = described("Who imported or trained it; null: nobody.")
    private: bool = described("Whether others may not see it.")
    parents: dict[str, str] = described("SHA-256 by name of the scenes that edits made it of; empty: it was trained.")
    edits: list[str] = described("What was done to them, each in JSON; `left_out`: what it did not keep.")
    made_labels: list[str] = described("Names of the labels of what was never recorded: put in, made or moved.")

    @property
    def bounds_min_mm(self) -> Position:
        return self.bounds.min_mm

    @property
    def bounds_max_mm(self) -> Position:
        return self.bounds.max_mm

    @classmethod
    def of(cls, name: str, header: SceneHeader, loaded_processes: int, ownership: Ownership) -> Scene:
        info, model = header.info, read_model(header.info.confidence, len(header.training_poses))
        return made_of(
            cls,
            info,
            header,
            ownership,
            name=name,
            loaded=loaded_processes > 0,
            loaded_processes=loaded_processes,
            centre_mm=Position.of(info.centre_mm),
            bounds=Bounds(Position.of(info.bounds_min_mm), Position.of(info.bounds_max_mm)),
            training_poses=TrainingPoses.of(header),
            dataset_name=None if info.dataset_name is None else str(info.dataset_name),
            dataset_sha256=None if info.dataset_sha256 is None else str(info.dataset_sha256),
            outputs=[name for name, output in OUTPUTS.items() if output.lacks(info) is None],
            confidence=None if model is None else ConfidenceFit(model.error, model.fitted_on),
            speckle=info.speckle is not None,
            parents=info.provenance.get("parents", {}),
            edits=[json.dumps(edit) for edit in info.provenance.get("edits", ())],
            made_labels=[info.label_names[label] for label in info.made_labels],
        )


@dataclass(frozen=True)
class SceneLoaded:
    """A scene after it was loaded or unloaded."""

    scene: str
    loaded: bool
    loaded_processes: int = described("How many render processes hold it.")

    @classmethod
    def of(cls, scene: str, loaded_processes: int) -> SceneLoaded:
        return cls(base_name(scene), loaded_processes > 0, loaded_processes)


class Scenes:
    def __init__(
        self,
        catalog: SceneCatalog,
        places: ScenePlaces,
        store: SceneStore,
        pool: RenderPool,
        owners: Owners,
        life: Life,
    ) -> None:
        self._catalog, self._places, self._store = catalog, places, store
        self._pool, self._owners, self._life = pool, owners, life

    async def get(self, name: str) -> Scene:
        header, name = await self._catalog.header(name), base_name(name)
        return Scene.of(name, header, self._pool.loaded().get(name, 0), self._owners.known(Kind.SCENE, name))

    async def page(self, page_size: int, page_token: str) -> ScenePage:
        entries, next_page_token = await self._catalog.page(page_size, page_token)
        loaded, removable = self._pool.loaded(), await asyncio.to_thread(self._store.names_of, self._places.artifacts)
        rows = [
            _entry(one, one.name in loaded, one.name in removable, self._owners.known(Kind.SCENE, one.name))
            for one in entries
        ]
        return ScenePage(rows, next_page_token)

    async def load(self, scene: str) -> SceneLoaded:
        return await self._changed(self._pool.load, scene)

    async def unload(self, scene: str) -> SceneLoaded:
        return await self._changed(self._pool.unload, scene)

    async def _changed(self, change: Callable[[str], Awaitable[None]], scene: str) -> SceneLoaded:
        self._life.require_serving()
        with scene_to_blame():
            name = await asyncio.to_thread(self._store.require, scene)
            await change(name)
        return SceneLoaded.of(scene, self._pool.loaded().get(name, 0))


def _entry(entry: CatalogEntry, loaded: bool, removable: bool, ownership: Ownership) -> SceneEntry:
    owner, private = ownership.owner, ownership.private
    if entry.error is not None:
        refusal = Refusal.of(entry.error)
        return SceneEntry(entry.name, loaded, removable, error=refusal, owner=owner, private=private)
    assert entry.header is not None
    info = entry.header.info
    return SceneEntry(
        entry.name,
        loaded,
        removable,
        info.gaussian_count,
        info.image_height,
        info.image_width,
        entry.header.file_bytes,
        owner=owner,
        private=private,
        probe_kind=None if info.probe is None else info.probe.kind,
        metrics=entry.header.info.metrics,
        changed_at=None if entry.changed_at_s is None else iso_time(entry.changed_at_s),
    )
