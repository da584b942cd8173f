"""Batches on a Ray cluster, for those who have one: a task for each shard, tried again where its worker dies.

A process of the cluster keeps the scene of its last shard loaded. The hosts of the cluster need the same release of
ultragray, and reach the place of the files: a folder that all have under one path, or a bucket. The extra `ray`.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import ultragray
from ultragray.errors import BackendUnavailable, InvalidArgument, RenderFailed, UltragrayError
from ultragray.exchange.batches import BatchPlan
from ultragray.installation import missing_extra
from ultragray_workers.batches.place import ShardPlace
from ultragray_workers.errors import StorageUnavailable
from ultragray_workers.storage.location import open_storage

if TYPE_CHECKING:
    from ultragray.exchange.shards import ShardRenderer

LOCAL, REMOTE = "ray", "ray://"
MOST_TRIES = 20  # of one shard, whose worker died
_AT_ONCE = 1_000  # tasks that the cluster is told of
_MAKING = ".making-"  # begins the name of a folder in which a shard is made


@dataclass(frozen=True)
class RayBatch:
    plan: BatchPlan
    scene_file: Path
    location: str  # of the files: a folder or the URL of a bucket
    backend: str = "auto"
    threads: int = 1  # of each task

    def render(self, address: str, report: Callable[[int], object]) -> None:
        """Makes the shards that are missing, then the manifest. `report` is told how many frames are done.

        `address`: "ray", for a cluster of this machine that ends with the call, or ray://HEAD:PORT.
        Raises ExtraMissing, InvalidArgument for a place that holds another batch, BackendUnavailable where the cluster
        cannot be used, RenderFailed where the workers of a shard keep dying, and what `ShardRenderer.render` raises.
        """
        ray = _import_ray()
        place = ShardPlace(open_storage(self.location), "", self.plan)
        if place.is_finished():
            report(self.plan.frames)
            return
        done = set(place.whole())
        count = sum(len(self.plan.frames_of(shard)) for shard in done)
        report(count)
        missing = iter([shard for shard in range(self.plan.shard_count) if shard not in done])
        _connect(ray, address)
        try:
            shared = ray.put(self.plan), ray.put(self.scene_file.read_bytes())
            waiting: dict[Any, int] = {}
            task = ray.remote(_make_shard).options(
                name="ultragray shard",
                num_cpus=self.threads,
                num_gpus=1 if self.backend == "cuda" else 0,
                max_retries=MOST_TRIES,
                retry_exceptions=[StorageUnavailable],
            )
            try:
                while True:
                    for shard in islice(missing, _AT_ONCE - len(waiting)):
                        arguments = (shard, self.location, self.backend, self.threads, ultragray.__version__)
                        waiting[task.remote(*shared, *arguments)] = shard
                    if not waiting:
                        break
                    ready, _ = ray.wait(list(waiting))
                    for one in ready:
                        count += _result(ray, one, waiting.pop(one))
                    report(count)
            finally:
                for one in waiting:
                    ray.cancel(one, force=False)
        finally:
            ray.shutdown()
        place.finish()
        if (making := place.storage.in_place(_MAKING)) is not None:
            for leftover in making.parent.glob(f"{_MAKING}*"):  # by workers that died
                shutil.rmtree(leftover, ignore_errors=True)


def check_address(address: str) -> None:
    """Raises InvalidArgument for what names no engine, ExtraMissing where Ray is not installed."""
    if address != LOCAL and not address.startswith(REMOTE):
        raise InvalidArgument(f"on must be ray or ray://HEAD:PORT, got {address!r}", field="on")
    _import_ray()


def _import_ray() -> Any:
    try:
        import ray
    except ImportError as error:
        raise missing_extra(error, "rendering on Ray", field="on") from error
    return ray


def _connect(ray: Any, address: str) -> None:
    try:
        if address == LOCAL:
            ray.init(include_dashboard=False, configure_logging=False, log_to_driver=False)
        else:
            ray.init(address, configure_logging=False, log_to_driver=False)
    except (ConnectionError, RuntimeError, TimeoutError) as error:
        reason = " ".join(str(error).split())
        raise BackendUnavailable(f"the Ray cluster {address} cannot be used: {reason}", field="on") from error


def _result(ray: Any, reference: Any, shard: int) -> int:
    try:
        frames: int = ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        if isinstance(error.cause, UltragrayError):
            raise type(error.cause)(f"shard {shard}: {error.cause.detail}") from None
        raise RenderFailed(f"shard {shard}: {error.cause}") from error
    except ray.exceptions.RayError as error:
        raise RenderFailed(f"shard {shard}: its worker died {MOST_TRIES + 1} times ({type(error).__name__})") from error
    return frames


# In a worker of the cluster.

_last_renderer: tuple[str, ShardRenderer] | None = None  # of the last shard, by what it was made for


def _make_shard(
    plan: BatchPlan, scene: bytes, shard: int, location: str, backend: str, threads: int, version: str
) -> int:
    """The number of frames of a shard, which is then in its place."""
    import torch

    if version != ultragray.__version__:
        raise BackendUnavailable(
            f"the Ray cluster has ultragray {ultragray.__version__}, this is {version}: they must be the same",
            field="on",
        )
    torch.set_num_threads(threads)
    storage = open_storage(location)
    place = ShardPlace(storage, "", plan)
    if place.entry(shard) is None:
        renderer = _renderer(plan, scene, backend)
        beside = None if (making := storage.in_place(_MAKING)) is None else making.parent
        if beside is not None:
            beside.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=beside, prefix=_MAKING) as folder:
            path = Path(folder) / plan.file_name(shard)
            place.keep(path, shard, renderer.render(shard, path))
    return len(plan.frames_of(shard))


def _renderer(plan: BatchPlan, scene: bytes, backend: str) -> ShardRenderer:
    global _last_renderer
    from ultragray.exchange.shards import ShardRenderer
    from ultragray.rendering.backends.registry import render_device

    wanted = f"{plan.identity} {backend}"
    if _last_renderer is None or _last_renderer[0] != wanted:
        _last_renderer = None  # the old scene goes first
        with tempfile.NamedTemporaryFile(suffix=".ugr") as file:
            file.write(scene)
            file.flush()
            _last_renderer = wanted, ShardRenderer(plan, Path(file.name), render_device(backend), backend=backend)
    return _last_renderer[1]
