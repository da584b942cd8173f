"""The one place of the service's state: settings, scenes, pool, metrics, and the phase of its life."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from enum import Enum

from ultragray.errors import UltragrayError
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.errors import Draining, NotReady, StartupFailed
from ultragray_workers.jobs.store import SCENES_FOLDER, JobStore
from ultragray_workers.pool.pool import PoolConfig, RenderPool
from ultragray_workers.pool.types import RenderRequest, RenderResult
from ultragray_workers.pool.waiting import Turn
from ultragray_workers.scenes import SceneStore

from ..auth import KeyGuard
from ..settings import Settings
from ..telemetry.metrics import Metrics
from ..views.comparisons import Comparisons
from ..views.datasets import DatasetViews
from ..views.training import TrainingViews
from .catalog import SceneCatalog, scene_to_blame
from .dataset_uploads import DatasetUploads
from .helper_processes import HelperProcesses
from .jobs.jobs import Jobs
from .requests import RequestPlanner
from .scene_imports import SceneImports


class Phase(Enum):
    """The phases of the service's life."""

    STARTING = "starting"
    SERVING = "serving"
    DRAINING = "draining"


class Service:
    """All that the front doors share."""

    def __init__(self, settings: Settings) -> None:
        if not settings.data_folder.is_dir():
            raise StartupFailed(
                f"data_folder must be an existing folder, got {str(settings.data_folder)!r}",
                field="data_folder",
            )
        store = SceneStore(settings.data_folder, settings.artifacts / SCENES_FOLDER)
        self.settings = settings
        self.scenes = store
        self.catalog = SceneCatalog(store)
        self.planner = RequestPlanner(settings, self.catalog)
        self.guard = KeyGuard(settings.api_keys)
        self.pool = RenderPool(
            store,
            PoolConfig(
                processes=settings.processes,
                threads_per_process=settings.threads_per_process,
                queue_limit_frames=settings.queue_limit_frames,
                max_batch_poses=settings.max_batch_poses,
                memory_budget_bytes=settings.memory_budget_mb * 2**20,
                backend=settings.backend,
            ),
        )
        self.jobs = Jobs(settings, store)
        self.metrics = Metrics(self.pool, lambda: self.jobs.counts)
        self.pool.on_rendered = self.metrics.observe_result
        self.phase = Phase.STARTING
        self.draining = asyncio.Event()
        self.datasets = DatasetStore(settings.artifacts)
        # Each process may take all the memory that settings allow to one: one checks at a time, and one makes pictures.
        checks, pictures = (HelperProcesses(settings.dataset_memory_mb << 20) for _ in range(2))
        self.uploads = DatasetUploads(self.datasets, settings, self.draining, checks)
        self.datasets.in_use = self.jobs.uses_dataset
        self.imports = SceneImports(store, settings, lambda name: self.jobs.do(JobStore.makes_scene, name), checks)
        self.dataset_views = DatasetViews(self.datasets, settings, pictures)
        self.comparisons = Comparisons(store, self.catalog, self.datasets, settings, pictures)
        self.training_views = TrainingViews(self.jobs, self.datasets, settings, pictures)
        self._prepared = (self.dataset_views, self.comparisons, self.training_views)

    @property
    def ready(self) -> bool:
        """Whether a frame asked for now would be rendered."""
        return self.phase is Phase.SERVING and self.pool.ready

    def require_ready(self) -> None:
        """Raises NotReady or Draining, saying why no frame would be rendered now."""
        self.require_serving()
        if not self.pool.ready:
            raise NotReady("no render process is alive at the moment")

    def require_serving(self) -> None:
        """Raises NotReady or Draining."""
        if self.phase is Phase.STARTING:
            raise NotReady("the service is starting")
        if self.phase is Phase.DRAINING:
            raise Draining("the service is stopping")

    async def start(self) -> None:
        """Starts the pool, loads the scenes to preload, opens the jobs, clears what dead uploads left.

        Raises StartupFailed.
        """
        await self.uploads.remove_stale()
        await self.imports.remove_stale()
        for prepared in self._prepared:
            await prepared.remove_stale()
        present = await asyncio.to_thread(self.datasets.names_by_content)
        await self._forget(lambda key: key.rpartition("-")[2] not in present)
        await self.training_views.forget(lambda key: True)  # a training that goes on has new ones
        await asyncio.gather(self.pool.start(), self.jobs.start())
        for name in self.settings.preload:
            try:
                await self.pool.load(name)
            except UltragrayError as error:
                raise StartupFailed(f"scene {name!r} cannot be preloaded: {error.detail}", field="preload") from error
        if self.phase is Phase.STARTING:
            self.phase = Phase.SERVING

    async def render(self, request: RenderRequest, turn: Turn | None = None) -> RenderResult:
        """Renders. Raises what RenderPool.render raises; cancelling drops a request that still waits."""
        self.require_serving()
        with scene_to_blame():
            return await self.pool.render(request, turn)

    async def load(self, scene: str) -> int:
        """Loads a scene into every process; how many hold it.

        Raises SceneNotFound, SceneFileInvalid, SceneTooLarge.
        """
        self.require_serving()
        with scene_to_blame():
            await self.pool.load(scene)
        return self.pool.loaded().get(scene, 0)

    async def unload(self, scene: str) -> int:
        """Frees a scene; how many processes still hold it. Raises SceneNotFound."""
        self.require_serving()
        with scene_to_blame():
            await self.pool.unload(scene)
        return self.pool.loaded().get(scene, 0)

    async def delete_dataset(self, name: str) -> None:
        """Deletes a dataset, and all that was made of it to be looked at. Raises DatasetNotFound, DatasetInUse."""
        deleted = (await asyncio.to_thread(self.datasets.get, name)).sha256
        await asyncio.to_thread(self.datasets.delete, name)
        if deleted not in await asyncio.to_thread(self.datasets.names_by_content):
            await self._forget(lambda key: key.endswith(deleted))

    async def delete_job(self, job_id: str) -> None:
        """Deletes a finished job and its files. Raises JobNotFound, JobInUse, DatabaseUnavailable."""
        await self.jobs.do(JobStore.delete, job_id)
        await self.training_views.forget_job(job_id)

    async def _forget(self, is_doomed: Callable[[str], bool]) -> None:
        for prepared in self._prepared:
            await prepared.forget(is_doomed)

    def begin_draining(self) -> None:
        """From now on frames are refused with Draining; streams end after the frames they have in flight."""
        self.phase = Phase.DRAINING
        self.draining.set()
        self.jobs.hub.close()
        for prepared in self._prepared:
            prepared.end()
