"""The one place where the parts of the service are made and given to each other, each after those that it needs."""

from __future__ import annotations

from functools import partial
from typing import Any

from ultragray.contract import made_of
from ultragray_service.access.audit import AuditLog
from ultragray_service.access.credentials import EnvironmentKeys, Guard, Sessions
from ultragray_service.access.keys import KnownKeys
from ultragray_service.access.limits import Limits
from ultragray_service.access.oidc import Issuer, OidcTokens, parse_roles
from ultragray_service.access.origins import Origins
from ultragray_service.access.owners import Admission, Owners
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
from ultragray_service.core.threads import HelperProcesses
from ultragray_service.core.uploads import DatasetUploads, Means, Quotas, SceneImports
from ultragray_service.doors import Doors
from ultragray_service.service import Service
from ultragray_service.settings import Settings
from ultragray_service.telemetry.logs import Tracing, start_tracing
from ultragray_service.telemetry.metrics import Metrics
from ultragray_service.views.poses import Assessing
from ultragray_service.views.prepared import Comparisons, CompressedScenes, DatasetViews, Thumbnails, TrainingViews
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.jobs.owners import Kind
from ultragray_workers.jobs.store import JobStore
from ultragray_workers.pool.messages import PoolConfig, RenderResult
from ultragray_workers.pool.pool import RenderPool
from ultragray_workers.scenes import SceneStore
from ultragray_workers.storage.location import open_storage


def make_service(settings: Settings) -> Service:
    life, owners, tracing = Life(), Owners(), start_tracing("service")
    metrics = Metrics(lambda scene: owners.known(Kind.SCENE, scene).private)

    keys, tokens = KnownKeys(), oidc_tokens(settings)
    guard = Guard([keys, EnvironmentKeys(settings.api_keys), *([] if tokens is None else [tokens])])
    sessions, audit = Sessions(guard), AuditLog()
    limits = Limits(settings.allowance, metrics.count_limited)

    places = ScenePlaces(settings)
    scenes = SceneStore(places.data, places.artifacts, hides=partial(owners.hides, Kind.SCENE))
    datasets = DatasetStore(
        settings.working_folder,
        open_storage(settings.artifacts),
        settings.max_cache_bytes,
        hides=partial(owners.hides, Kind.DATASET),
    )
    catalog = SceneCatalog(scenes)
    registrations = Registrations(catalog, owners, limits)
    quotas = Quotas(limits, owners, datasets, scenes)
    # Each process may take all the memory that settings allow to one: one checks at a time, one makes pictures, one
    # labels a scene, one edits scenes, and one draws thumbnails, which would wait behind pictures for minutes.
    memory_bytes = settings.dataset_memory_mb << 20
    checks, pictures, labelling, editing, thumbnails = (HelperProcesses(memory_bytes) for _ in range(5))
    jobs = Jobs(settings, scenes, datasets, registrations.read_of_scene, quotas.admit_job, checks)

    pool = _pool(settings, places, metrics, tracing)
    planner = RequestPlanner(settings, catalog, registrations.of_scene)
    rendering = Rendering(pool, planner, life, owners, limits, metrics)
    metrics.read(pool, lambda: jobs.overview, places)

    admission = Admission(
        audit,
        limits,
        sessions,
        owners,
        {Kind.JOB: lambda job: jobs.do(JobStore.ownership, job), Kind.REGISTRATION: registrations.ownership},
        {Kind.SCENE: scenes.require, Kind.DATASET: datasets.require},
    )
    means = Means(settings, jobs, life.draining, checks, owners, quotas)
    imports = SceneImports(scenes, places.artifacts, means)
    return Service(
        settings=settings,
        life=life,
        doors=Doors.of(settings, settings.http_port, settings.grpc_port, None),
        keys=keys,
        tokens=tokens,
        guard=guard,
        sessions=sessions,
        origins=Origins(settings.host, names=settings.allowed_hosts, pages=settings.cors_origins),
        owners=owners,
        limits=limits,
        audit=audit,
        admission=admission,
        places=places,
        scene_store=scenes,
        catalog=catalog,
        scenes=Scenes(catalog, places, scenes, pool, owners, life),
        datasets=Datasets(datasets, owners),
        registrations=registrations,
        jobs=jobs,
        uploads=DatasetUploads(datasets, means),
        recordings=OpenRecordings(datasets, means),
        imports=imports,
        edits=SceneEdits(scenes, imports, registrations, owners, editing, labelling, life),
        pool=pool,
        planner=planner,
        rendering=rendering,
        streams=OpenStreams(),
        assessing=Assessing(catalog, registrations),
        dataset_views=DatasetViews(datasets, settings, pictures),
        comparisons=Comparisons(scenes, catalog, datasets, settings, pictures),
        thumbnails=Thumbnails(scenes, catalog, settings, thumbnails),
        compressed=CompressedScenes(scenes, settings, thumbnails),
        training_views=TrainingViews(jobs, datasets, settings, pictures),
        readiness=Readiness(
            lambda: jobs.database,
            require_serving=life.require_staying,
            require_frames=rendering.require_frames,
            scenes=places,
            without_jobs=settings.ready_without_jobs,
        ),
        metrics=metrics,
        tracing=tracing,
    )


def _pool(settings: Settings, places: ScenePlaces, metrics: Metrics, tracing: Tracing | None) -> RenderPool:
    config = made_of(PoolConfig, settings, memory_budget_bytes=settings.memory_budget_mb * 2**20)

    def observe(result: RenderResult[Any]) -> None:
        metrics.observe_result(result)
        if tracing is not None:
            tracing.observe_result(result)

    # Scenes of its own: nothing is hidden from the pool, which works for everybody at once.
    return RenderPool(SceneStore(places.data, places.artifacts), config, observe)


def oidc_tokens(settings: Settings) -> OidcTokens | None:
    if settings.oidc_issuer is None:
        return None
    return OidcTokens(
        Issuer(settings.oidc_issuer, settings.oidc_ca),
        audience=settings.oidc_audience,
        role_claim=settings.oidc_role_claim,
        name_claim=settings.oidc_name_claim,
        roles=parse_roles(settings.oidc_roles),
    )
