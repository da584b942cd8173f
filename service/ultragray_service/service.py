"""The one place of the service's state: settings, scenes, pool, metrics, and the phase of its life."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from enum import Enum
from functools import partial
from typing import Any

from ultragray.errors import RenderFailed, UltragrayError
from ultragray.geometry.probe import FloatArray
from ultragray_service.access.audit import AuditLog, account
from ultragray_service.access.credentials import Authenticator, EnvironmentKeys, Guard, Sessions
from ultragray_service.access.keys import KnownKeys, Snapshot
from ultragray_service.access.limits import Limits
from ultragray_service.access.oidc import Issuer, OidcTokens, parse_roles
from ultragray_service.access.origins import Origins
from ultragray_service.access.owners import Owners, require
from ultragray_service.access.principals import Principal, act_as, caller, is_loopback
from ultragray_service.access.rules import Operation
from ultragray_service.core.scenes import SceneCatalog, ScenePlaces, scene_to_blame
from ultragray_service.core.jobs.jobs import Jobs
from ultragray_service.core.open_streams import OpenStreams
from ultragray_service.core.readiness import Readiness
from ultragray_service.core.registrations import Registrations
from ultragray_service.core.rendering import Plan, RequestPlanner
from ultragray_service.core.threads import HelperProcesses
from ultragray_service.core.uploads import DatasetUploads, Holdings, SceneImports
from ultragray_service.doors import Doors
from ultragray_service.settings import Settings
from ultragray_service.telemetry.logs import start_tracing
from ultragray_service.telemetry.metrics import Metrics
from ultragray_service.views.assessments import Assessing
from ultragray_service.views.prepared import Comparisons, DatasetViews, TrainingViews, simulated_sha256
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.errors import Draining, NotReady, SceneNotFound, StartupFailed
from ultragray_workers.jobs.owners import Kind
from ultragray_workers.jobs.store import JobStore
from ultragray_workers.pool.messages import Destination, Priority, RenderRequest, RenderResult, S, SceneChangedError
from ultragray_workers.pool.pool import MAX_SCENE_CHANGES, PoolConfig, RenderPool
from ultragray_workers.pool.waiting import Turn
from ultragray_workers.scenes import SceneStore
from ultragray_workers.storage.location import open_storage


class Phase(Enum):
    """The phases of the service's life."""

    STARTING = "starting"
    SERVING = "serving"
    LEAVING = "leaving"  # serves, and is not ready: proxies send what is new elsewhere
    DRAINING = "draining"


class Service:
    """All that the front doors share."""

    def __init__(self, settings: Settings) -> None:
        self.places = ScenePlaces(settings)
        store = SceneStore(self.places.data, self.places.made)
        self.settings = settings
        self.scenes = store
        self.catalog = SceneCatalog(store)
        self._keys = KnownKeys()
        self.tokens = oidc_tokens(settings)
        sources: list[Authenticator] = [self._keys, EnvironmentKeys(settings.api_keys)]
        self.guard = Guard(sources if self.tokens is None else [*sources, self.tokens])
        self._following_issuer: asyncio.Task[None] | None = None
        self.origins = Origins(settings.host, names=settings.allowed_hosts, pages=settings.cors_origins)
        self.sessions = Sessions(self.guard)
        self.audit = AuditLog()
        self._following_sessions: asyncio.Task[None] | None = None
        self._snapshot: Snapshot | None = None
        self.pool = RenderPool(
            # Its own: nothing is hidden from the pool, which works for everybody at once.
            SceneStore(self.places.data, self.places.made),
            PoolConfig(
                processes=settings.processes,
                threads_per_process=settings.threads_per_process,
                queue_limit_frames=settings.queue_limit_frames,
                client_limit_frames=settings.client_limit_frames,
                max_queue_ms=settings.max_queue_ms,
                max_batch_poses=settings.max_batch_poses,
                memory_budget_bytes=settings.memory_budget_mb * 2**20,
                max_footprint_pixels=settings.max_footprint_pixels,
                worker_grace_s=settings.worker_grace_s,
                worker_timeout_s=settings.worker_timeout_s,
                backend=settings.backend,
            ),
        )
        self.datasets = DatasetStore(
            settings.working_folder, open_storage(settings.artifacts), settings.max_cache_bytes
        )
        self.jobs = Jobs(
            settings, store, self.datasets, lambda name, scene: self.registrations.read_of_scene(name, scene)
        )
        self.readiness = Readiness(
            lambda: self.jobs.database,
            require_serving=self._require_staying,
            require_frames=self.require_frames,
            scenes=self.places,
            without_jobs=settings.ready_without_jobs,
        )
        self.owners = Owners(
            {
                Kind.JOB: lambda job_id: self.jobs.do(JobStore.ownership, job_id),
                Kind.REGISTRATION: lambda name: self.registrations.ownership(name),
            },
            {Kind.SCENE: store.require, Kind.DATASET: self.datasets.get},
        )
        store.hides = partial(self.owners.hides, Kind.SCENE)
        self.datasets.hides = partial(self.owners.hides, Kind.DATASET)
        self.metrics = Metrics(self.pool, lambda: self.jobs.overview, self.places)
        self.streams = OpenStreams()
        self.limits = Limits(settings.allowance, self.metrics.count_limited)
        self.registrations = Registrations(self.catalog, self.owners, self.limits)
        self.planner = RequestPlanner(settings, self.catalog, self.registrations.of_scene)
        holdings = Holdings(self.limits, self.owners, self.datasets, store, self.jobs)
        self.jobs.admit = holdings.admit_job
        self.tracing = start_tracing("service")
        self.pool.on_rendered = self._observe
        self.phase = Phase.STARTING
        self.doors = Doors.of(settings, settings.http_port, settings.grpc_port, None)  # until they are open
        self.draining = asyncio.Event()
        # Each process may take all the memory that settings allow to one: one checks at a time, and one makes pictures.
        checks, pictures = (HelperProcesses(settings.dataset_memory_mb << 20) for _ in range(2))
        self.uploads = DatasetUploads(self.datasets, settings, self.draining, checks, self.owners, holdings)
        self.datasets.in_use = self.jobs.uses_dataset
        self.imports = SceneImports(
            store, self.places.made, settings, self.jobs.makes_scene, checks, self.owners, holdings
        )
        self.dataset_views = DatasetViews(self.datasets, settings, pictures)
        self.comparisons = Comparisons(store, self.catalog, self.datasets, settings, pictures)
        self.assessing = Assessing(self.catalog, self.registrations)
        self.training_views = TrainingViews(self.jobs, self.datasets, settings, pictures)
        self._prepared = (self.dataset_views, self.comparisons, self.training_views)

    @asynccontextmanager
    async def permitted(
        self,
        principal: Principal,
        credential: str | None,
        operation: Operation,
        target: str,
        *,
        address: str,
        connection: str,
    ) -> AsyncIterator[None]:
        """What a caller may do runs within: counted, audited, and cut off when the credential counts no more.

        `connection`: the caller's address with the port. Raises RateLimited, PermissionDenied and JobNotFound.
        """
        act_as(principal, address=address, connection=connection)
        with self.audit.refusals(principal.name, address, operation, target):
            self.limits.take_request()
        with self.audit.request(principal.name, address, operation, target), self.sessions.held(principal, credential):
            await require(principal, operation, target, self.owners)
            yield

    def require_frames(self) -> None:
        """Raises NotReady or Draining, saying why no frame would be rendered now."""
        self.require_serving()
        if not self.pool.ready:
            raise NotReady("no render process is alive and gets on with its work at the moment")

    def require_serving(self) -> None:
        """Raises NotReady or Draining."""
        if self.phase is Phase.STARTING:
            raise NotReady("the service is starting")
        if self.phase is Phase.DRAINING:
            raise Draining("the service is stopping")

    def _require_staying(self) -> None:
        """Raises NotReady or Draining, the latter also while the service still serves and will stop."""
        self.require_serving()
        if self.phase is Phase.LEAVING:
            raise Draining("the service will stop; it still answers")

    async def open(self) -> None:
        """Opens the jobs' database, and reads keys, owners and registrations; before any door opens.

        Raises StartupFailed.
        """
        await self.places.open()
        await self.jobs.open()
        self._snapshot = await asyncio.to_thread(
            Snapshot, self.jobs.database.engine, self._keys, (self.owners.read, self.registrations.read)
        )
        self.owners.open(self.jobs.database.engine, self.jobs.threads.executor)
        self.registrations.open(self.jobs.database.engine, self.jobs.threads)
        self.audit.open(self.jobs.database.engine)
        self._following_sessions = asyncio.create_task(self.sessions.follow())
        if self.tokens is not None:
            self._following_issuer = asyncio.create_task(self.tokens.issuer.follow())
        settings = self.settings
        if not (self.guard.asks or settings.insecure or is_loopback(settings.host)):
            raise StartupFailed(
                f"nobody is asked for an API key, and {settings.host} can be reached from other machines: make a key "
                "with `ultragray keys create`, or set ULTRAGRAY_API_KEYS; ULTRAGRAY_INSECURE=true serves all the same, "
                "and everybody is an admin then",
                field="host",
            )

    async def close(self) -> None:
        """Closes what `open` opened, and sends the last traces."""
        if self._following_issuer is not None:
            self._following_issuer.cancel()
        if self._following_sessions is not None:
            self._following_sessions.cancel()
        if self._snapshot is not None:
            await asyncio.to_thread(self._snapshot.close)
        await asyncio.to_thread(self.audit.close)
        self.readiness.close()
        await self.jobs.close()
        await self.places.close()
        if self.tracing is not None:
            await asyncio.to_thread(self.tracing.stop)

    async def start(self) -> None:
        """Starts the pool, loads the scenes to preload, clears what dead uploads left.

        Raises StartupFailed.
        """
        await self.uploads.remove_stale()
        await self.imports.remove_stale()
        for prepared in self._prepared:
            await prepared.remove_stale()
        present = {*await asyncio.to_thread(self.datasets.names_by_content), await asyncio.to_thread(simulated_sha256)}
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
        if self.phase is Phase.STARTING:
            self.phase = Phase.SERVING

    async def render(
        self,
        plan: Plan[S],
        poses: FloatArray,  # [C, 4, 4] mm, exact
        *,
        deadline: float | None,  # time.monotonic() in seconds
        priority: Priority = Priority.INTERACTIVE,
        turn: Turn | None = None,
        begin_by: float | None = None,  # time.monotonic() in seconds; else it is refused
        destination: Destination | None = None,
    ) -> RenderResult[S]:
        """Renders, with the settings as they are for the scene that is there when it is rendered.

        Raises what RenderPool.render and Plan.renew raise; cancelling drops a request that still waits.
        """
        self.require_serving()
        mine = account()
        mine.target = plan.scene
        mine.frames += len(poses)
        if self.owners.hides(Kind.SCENE, plan.scene):  # since a stream began, for example
            raise SceneNotFound(f"there is no scene {plan.scene!r} any more", field="scene")
        turn = turn or Turn()
        for _ in range(MAX_SCENE_CHANGES):
            asked = RenderRequest(
                plan.scene, plan.settings, poses, priority, deadline, plan.version, caller(), begin_by, destination
            )
            try:
                with scene_to_blame():
                    return await self.pool.render(asked, turn)
            except SceneChangedError:
                if turn.ticket is not None:  # perhaps with newer poses
                    poses, deadline = turn.ticket.request.poses, turn.ticket.request.deadline
                await plan.renew()
        raise RenderFailed(f"scene {plan.scene!r} kept changing while it was being rendered", field="scene")

    async def load(self, scene: str) -> int:
        """Loads a scene into every process; how many hold it.

        Raises SceneNotFound, SceneFileInvalid, SceneTooLarge.
        """
        self.require_serving()
        with scene_to_blame():
            name = await asyncio.to_thread(self.scenes.require, scene)
            await self.pool.load(name)
        return self.pool.loaded().get(name, 0)

    async def unload(self, scene: str) -> int:
        """Frees a scene; how many processes still hold it. Raises SceneNotFound."""
        self.require_serving()
        with scene_to_blame():
            name = await asyncio.to_thread(self.scenes.require, scene)
            await self.pool.unload(name)
        return self.pool.loaded().get(name, 0)

    async def delete_dataset(self, name: str) -> None:
        """Deletes a dataset, and all that was made of it to be looked at. Raises DatasetNotFound, DatasetInUse."""
        deleted = (await asyncio.to_thread(self.datasets.get, name)).sha256
        async with self.owners.removing(Kind.DATASET, name):
            await asyncio.to_thread(self.datasets.delete, name)
        if deleted not in await asyncio.to_thread(self.datasets.names_by_content):
            await self._forget(lambda key: key.endswith(deleted))

    async def delete_job(self, job_id: str) -> None:
        """Deletes a finished job and its files. Raises JobNotFound, JobInUse, DatabaseUnavailable."""
        await self.jobs.do(JobStore.delete, job_id)
        await self.training_views.forget_job(job_id)

    def _observe(self, result: RenderResult[Any]) -> None:
        self.metrics.observe_result(result)
        if self.tracing is not None:
            self.tracing.observe_result(result)

    async def _forget(self, is_doomed: Callable[[str], bool]) -> None:
        for prepared in self._prepared:
            await prepared.forget(is_doomed)

    def begin_leaving(self) -> None:
        """From now on the service is not ready, and answers as before."""
        self.phase = Phase.LEAVING

    def begin_draining(self) -> None:
        """From now on frames are refused with Draining; streams end after the frames they have in flight."""
        self.phase = Phase.DRAINING
        self.draining.set()
        self.jobs.hub.close()
        for prepared in self._prepared:
            prepared.end()


def oidc_tokens(settings: Settings) -> OidcTokens | None:
    """The tokens of the settings; None: they name no issuer."""
    if settings.oidc_issuer is None:
        return None
    return OidcTokens(
        Issuer(settings.oidc_issuer, settings.oidc_ca),
        audience=settings.oidc_audience,
        role_claim=settings.oidc_role_claim,
        name_claim=settings.oidc_name_claim,
        roles=parse_roles(settings.oidc_roles),
    )
