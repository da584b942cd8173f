"""The service: its parts, one object a concern, and the order in which they open, start and close.

`wiring` makes the parts; the doors (`http`, `rpc`, `igtl`) are given a `Service` and ask its parts; `server` runs both.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass

from ultragray.errors import UltragrayError
from ultragray.phantom.demo import simulated_sha256
from ultragray_service.access.audit import AuditLog
from ultragray_service.access.credentials import Guard, Sessions
from ultragray_service.access.keys import KnownKeys, Snapshot
from ultragray_service.access.limits import Limits
from ultragray_service.access.oidc import OidcTokens
from ultragray_service.access.origins import Origins
from ultragray_service.access.owners import Admission, Owners
from ultragray_service.access.principals import is_loopback
from ultragray_service.core.datasets import Datasets
from ultragray_service.core.editing import SceneEdits
from ultragray_service.core.jobs import Jobs
from ultragray_service.core.life import Life
from ultragray_service.core.open_streams import OpenStreams
from ultragray_service.core.readiness import Readiness
from ultragray_service.core.recordings import OpenRecordings
from ultragray_service.core.registrations import Registrations
from ultragray_service.core.rendering import Rendering, RequestPlanner
from ultragray_service.core.scenes import SceneCatalog, ScenePlaces, Scenes
from ultragray_service.core.uploads import DatasetUploads, SceneImports
from ultragray_service.doors import Doors
from ultragray_service.settings import Settings
from ultragray_service.telemetry.logs import Tracing
from ultragray_service.telemetry.metrics import Metrics
from ultragray_service.views.poses import Assessing
from ultragray_service.views.prepared import Comparisons, CompressedScenes, DatasetViews, Thumbnails, TrainingViews
from ultragray_workers.errors import StartupFailed
from ultragray_workers.jobs.store import JobStore
from ultragray_workers.pool.pool import RenderPool
from ultragray_workers.scenes import SceneStore


@dataclass(eq=False, kw_only=True)
class Service:
    settings: Settings
    life: Life
    doors: Doors  # as they will be, until they are open
    # Who may do what, and who did.
    keys: KnownKeys
    tokens: OidcTokens | None
    guard: Guard
    sessions: Sessions
    origins: Origins
    owners: Owners
    limits: Limits
    audit: AuditLog
    admission: Admission
    # What is there.
    places: ScenePlaces
    scene_store: SceneStore
    catalog: SceneCatalog
    scenes: Scenes
    datasets: Datasets
    registrations: Registrations
    jobs: Jobs
    uploads: DatasetUploads
    recordings: OpenRecordings
    imports: SceneImports
    edits: SceneEdits
    # What is made of it.
    pool: RenderPool
    planner: RequestPlanner
    rendering: Rendering
    streams: OpenStreams
    assessing: Assessing
    dataset_views: DatasetViews
    comparisons: Comparisons
    thumbnails: Thumbnails
    compressed: CompressedScenes
    training_views: TrainingViews
    # How it goes.
    readiness: Readiness
    metrics: Metrics
    tracing: Tracing | None

    def __post_init__(self) -> None:
        self._of_datasets = (self.dataset_views, self.comparisons, self.training_views)
        self._prepared = (*self._of_datasets, self.thumbnails, self.compressed)
        self._following: list[asyncio.Task[None]] = []
        self._snapshot: Snapshot | None = None

    async def open(self) -> None:
        """Opens database and copies of keys, owners and registrations, before any door opens. Raises StartupFailed."""
        await self.places.open()
        await self.jobs.open()
        engine = self.jobs.database.engine
        self._snapshot = await asyncio.to_thread(
            Snapshot, engine, self.keys, (self.owners.read, self.registrations.read)
        )
        self.owners.open(engine, self.jobs.threads.executor)
        self.registrations.open(engine, self.jobs.threads)
        self.audit.open(engine)
        self._following = [asyncio.create_task(self.sessions.follow())]
        if self.tokens is not None:
            self._following.append(asyncio.create_task(self.tokens.issuer.follow()))
        settings = self.settings
        if not (self.guard.asks or settings.insecure or is_loopback(settings.host)):
            raise StartupFailed(
                f"nobody is asked for an API key, and {settings.host} can be reached from other machines: make a key "
                "with `ultragray keys create`, or set ULTRAGRAY_API_KEYS; ULTRAGRAY_INSECURE=true serves all the same, "
                "and everybody is an admin then",
                field="host",
            )

    async def start(self) -> None:
        """Starts the pool, loads the scenes to preload, clears what dead uploads left. Raises StartupFailed."""
        await self.uploads.remove_stale()
        await self.imports.remove_stale()
        for prepared in self._prepared:
            await prepared.remove_stale()
        present = {*await self.datasets.contents(), await asyncio.to_thread(simulated_sha256)}
        await self._forget(lambda key: key.rpartition("-")[2] not in present)
        await self.training_views.forget(lambda key: True)  # a training that goes on has new ones
        self.jobs.start()
        await self.readiness.start()
        await self.pool.start()
        for name in self.settings.preload:
            try:
                await self.pool.load(name)
            except UltragrayError as error:
                raise StartupFailed(f"scene {name!r} cannot be preloaded: {error.detail}", field="preload") from error
        self.life.begin_serving()

    def begin_draining(self) -> None:
        """From now on frames are refused with Draining; streams end after the frames they have in flight."""
        self.life.begin_draining()
        self.jobs.hub.closing.set()
        for prepared in self._prepared:
            prepared.end()

    async def close(self) -> None:
        for task in self._following:
            task.cancel()
        if self._snapshot is not None:
            await asyncio.to_thread(self._snapshot.close)
        await asyncio.to_thread(self.audit.close)
        self.readiness.close()
        await self.jobs.close()
        await self.places.close()
        if self.tracing is not None:
            await asyncio.to_thread(self.tracing.stop)

    async def delete_dataset(self, name: str) -> None:
        gone = await self.datasets.delete(name, self.jobs.uses_dataset)
        if gone is not None:
            await self._forget(lambda key: key.endswith(gone))

    async def delete_job(self, job_id: str) -> None:
        await self.jobs.do(JobStore.delete, job_id)
        await self.training_views.forget_job(job_id)

    async def _forget(self, is_doomed: Callable[[str], bool]) -> None:
        for prepared in self._of_datasets:
            await prepared.forget(is_doomed)
