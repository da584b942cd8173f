"""Pictures and figures that helper processes make in the background, once each, and that are kept in folders.

`Prepared` keeps the folders; after it come those of a data set's frames, of a training while it runs, and of a scene
beside the held-out frames of its data set.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, ClassVar, Literal

import numpy as np

from ultragray.contract import described
from ultragray.datasets.source import PHANTOM
from ultragray.errors import DatasetInvalid, TrainingStateInvalid, UltragrayError
from ultragray.files import sync
from ultragray.phantom.demo import simulated_sha256
from ultragray.rendering.pixels import encoded_image
from ultragray.rendering.settings import Encoding
from ultragray_service.core.jobs import Jobs
from ultragray_service.core.poses import MatrixRows
from ultragray_service.core.scenes import SceneCatalog
from ultragray_service.core.threads import HelperProcesses, in_own_thread, to_its_end
from ultragray_service.settings import Settings
from ultragray_workers.claims import age_s, claimed_folder, remove_abandoned, remove_whole, storage_full
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.errors import ArtifactNotFound, DatasetNotFound, Draining
from ultragray_workers.helpers import read_picture
from ultragray_workers.jobs.record import Job
from ultragray_workers.jobs.store import JobStore
from ultragray_workers.scenes import SceneStore
from ultragray_workers.views import (
    COMPRESSED_NAME,
    FRAMES_NAME,
    PICTURES,
    POSES_NAME,
    PREVIEW_PICTURES,
    THUMBNAIL_NAME,
    compare,
    compress_scene,
    draw_preview,
    draw_thumbnail,
    lay_out,
)

TIMEOUT_S = 1800.0
KEPT_FOLDERS = 32
_FAILURE_KEPT_S = 60.0  # then it is tried again
_PREFIX, _CONTENT = ".making-", "content"

_log = logging.getLogger("ultragray.service")


@dataclass(frozen=True)
class Preparation:
    """The state of a folder; `error` where it could not be made."""

    state: Literal["running", "ready", "failed"]
    error: UltragrayError | None = None


class Prepared:
    """Base of a kind of pictures and figures: one folder for each key, which names what is in it.

    A subclass says in which folder of the artifact folder its own lie, what its helper process does, in the words of
    errors, and which function fills a folder: it takes `folder`, `artifact_folder`, `storage` where hosts share one,
    and what the kind asks of it. Keys end with the SHA-256 of what the pictures are of. The folders that
    were asked for last are kept: KEPT_FOLDERS, and beside the newest no more bytes than a dataset may have. All methods
    belong to one event loop.
    """

    name: ClassVar[str]
    what: ClassVar[str]
    fill: ClassVar[Callable[..., None]]  # a staticmethod
    most_factor: ClassVar[int] = 1  # KEPT_FOLDERS times this are kept

    def __init__(self, settings: Settings, processes: HelperProcesses) -> None:
        self._origins: dict[str, str | int] = {"artifact_folder": str(settings.working_folder)}
        if not isinstance(settings.artifacts, Path):
            self._origins |= {"storage": str(settings.artifacts), "max_copies_bytes": settings.max_cache_bytes}
        self.folder = settings.working_folder / self.name
        self._processes = processes
        self._kept_bytes = settings.max_dataset_bytes
        self._tasks: dict[str, asyncio.Task[UltragrayError | None]] = {}
        self._making: dict[str, Path] = {}
        self._failures: dict[str, tuple[float, UltragrayError]] = {}
        self._ended = False

    async def prepare(self, key: str, **arguments: str | None) -> Preparation:
        """Begin to make the folder unless it is there, or failed a minute ago. Raises Draining."""
        if await asyncio.to_thread(self._touch, key):
            return Preparation("ready")
        if (error := self._failure(key)) is not None:
            return Preparation("failed", error)
        self._task(key, arguments)
        return Preparation("running")

    async def path(self, key: str, **arguments: str | None) -> Path:
        """The folder, made first where it is not there.

        Raises what the helper process raises, also where it did so a minute ago, DeadlineExceeded, MemoryExceeded,
        StorageFull, Draining, and ArtifactNotFound where it is removed meanwhile.
        """
        if await asyncio.to_thread(self._touch, key):
            return self.folder / key
        if (error := self._failure(key)) is None:
            task = self._task(key, arguments)
            await asyncio.wait({task})
            if task.cancelled():
                if self._ended:
                    raise Draining("the service is stopping")
                raise ArtifactNotFound("what was to be shown has been deleted meanwhile")
            error = task.result()
        if error is not None:
            raise error.with_traceback(None)
        return self.folder / key

    async def picture_png(self, key: str, index: int, *names: str) -> bytes | None:
        """Frame `index` of the stacks of these names, side by side; None where one is not there (yet, or any more)."""

        def read() -> bytes | None:
            for folder in self._places(key):
                pictures = [picture for name in names if (picture := read_picture(folder, name, index)) is not None]
                if len(pictures) == len(names):
                    return encoded_image(np.concatenate(pictures, axis=1), Encoding.PNG)
            return None

        return await asyncio.to_thread(read)

    async def settled(self, is_asked: Callable[[str], bool]) -> None:
        if tasks := {task for key, task in self._tasks.items() if is_asked(key)}:
            await asyncio.wait(tasks)

    def end(self) -> None:
        self._ended = True
        for task in self._tasks.values():
            task.cancel()

    async def forget(self, is_doomed: Callable[[str], bool]) -> None:
        doomed = {task for key, task in self._tasks.items() if is_doomed(key)}
        for task in doomed:
            task.cancel()
        if doomed:
            await asyncio.wait(doomed)

        def remove() -> None:
            for folder in self._kept():
                if is_doomed(folder.name):
                    remove_whole(folder, _PREFIX)

        await in_own_thread(remove)

    async def remove_stale(self) -> None:
        await in_own_thread(lambda: remove_abandoned(self.folder, _PREFIX))

    def _task(self, key: str, arguments: dict[str, str | None]) -> asyncio.Task[UltragrayError | None]:
        if self._ended:
            raise Draining("the service is stopping")
        task = self._tasks.get(key)
        if task is None:
            task = self._tasks[key] = asyncio.create_task(self._make(key, arguments))
            task.add_done_callback(lambda _: self._tasks.pop(key, None))
        return task

    async def _make(self, key: str, arguments: dict[str, str | None]) -> UltragrayError | None:
        claim = ExitStack()
        error: UltragrayError | None = None

        def begin() -> Path:
            making = claim.enter_context(claimed_folder(self.folder, _PREFIX)) / _CONTENT
            making.mkdir()
            return making

        try:
            with storage_full(self.what):
                making = self._making[key] = await to_its_end(begin)
                await self._processes.run(
                    self.fill,
                    {**arguments, **self._origins, "folder": str(making)},
                    what=self.what,
                    timeout_s=TIMEOUT_S,
                    killed=DatasetInvalid,
                )
                await to_its_end(lambda: self._keep(making, key))
        except UltragrayError as caught:
            error = caught
        except Exception:
            _log.exception(f"{self.what} failed unexpectedly")
            error = UltragrayError(f"{self.what} failed unexpectedly, see the log")
        finally:
            self._making.pop(key, None)
            await to_its_end(claim.close)
        if error is not None and not isinstance(error, DatasetNotFound):  # another name may have the same content
            self._failures[key] = (time.monotonic(), error)
        return error

    def _failure(self, key: str) -> UltragrayError | None:
        now = time.monotonic()
        self._failures = {key: one for key, one in self._failures.items() if now - one[0] < _FAILURE_KEPT_S}
        return self._failures[key][1] if key in self._failures else None

    def _touch(self, key: str) -> bool:
        """Whether the folder is there; it then counts as the one asked for last."""
        try:
            os.utime(self.folder / key)
        except FileNotFoundError:
            return False
        return True

    def _places(self, key: str) -> list[Path]:
        """Where a folder can be read: while it is made, too. In this order, it is not missed as it gets its name."""
        making = self._making.get(key)
        return [*([] if making is None else [making]), self.folder / key]

    def _keep(self, making: Path, key: str) -> None:
        for path in (*making.iterdir(), making):
            sync(path)
        try:
            making.rename(self.folder / key)
        except OSError:
            if not (self.folder / key).is_dir():  # else another service was quicker
                raise
        sync(self.folder)
        self._remove_oldest(key)
        remove_abandoned(self.folder, _PREFIX)

    def _remove_oldest(self, newest: str) -> None:
        others = sorted((folder for folder in self._kept() if folder.name != newest), key=age_s)
        held_bytes = 0
        for count, folder in enumerate(others, 2):
            held_bytes += _size_bytes(folder)
            if count > KEPT_FOLDERS * self.most_factor or held_bytes > self._kept_bytes:
                remove_whole(folder, _PREFIX)

    def _kept(self) -> list[Path]:
        return [path for path in self.folder.glob("*") if not path.name.startswith(".")]


def _size_bytes(folder: Path) -> int:
    try:
        return sum(path.stat().st_size for path in folder.iterdir())
    except FileNotFoundError:
        return 0


@dataclass(frozen=True)
class DatasetPoses:
    """The poses of a dataset."""

    train: list[list[float]] = described("16 numbers each, row by row, mm.")
    val: list[list[float]] = described("Of the held-out frames.")


class DatasetViews(Prepared):
    name, what, fill = "dataset-views", "laying out the frames of the dataset", staticmethod(lay_out)

    def __init__(self, store: DatasetStore, settings: Settings, processes: HelperProcesses) -> None:
        super().__init__(settings, processes)
        self._store = store

    async def key(self, name: str) -> str:
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


MAX_POINTS = 500


@dataclass(frozen=True)
class CurvePoint:
    """Neighbouring steps of a training as one."""

    step: int = described("The last of them.")
    loss: float = described("Their mean.")
    val_psnr_db: float | None = described("On held-out frames, measured last; null where it was not.")


@dataclass(frozen=True)
class TrainingCurve:
    """A training so far."""

    points: list[CurvePoint] = described(f"At most {MAX_POINTS}; none before the first step.")
    baselines: dict[str, float] = described(
        "PSNR in dB of classical methods on the frames of val_psnr_db, by name (linear: between the nearest frames; "
        "median: compounded; in-time: of the neighbours in time, in the same recording); empty where they were not "
        "measured."
    )


class TrainingViews(Prepared):
    """Curves and previews of trainings, running or finished. A preview is kept by job, checkpoint and dataset."""

    name, what, fill = "previews", "rendering the training as it is", staticmethod(draw_preview)

    def __init__(self, jobs: Jobs, datasets: DatasetStore, settings: Settings, processes: HelperProcesses) -> None:
        super().__init__(settings, processes)
        self._jobs, self._datasets = jobs, datasets

    async def curve(self, job_id: str) -> TrainingCurve:
        journal, baselines = await self._jobs.do(_texts, job_id)
        return TrainingCurve(_curve_of(journal), json.loads(baselines or "{}"))

    async def preview_png(self, job_id: str) -> bytes:
        """Truth, and to its right the rendering, PNG.

        Raises JobNotFound, ArtifactNotFound without a checkpoint, DatasetNotFound, and as `Prepared.path`.
        """
        job = await self._jobs.do(JobStore.get, job_id)
        await self.settled(lambda key: key.startswith(f"{job_id}-"))  # one a job at a time: the newest
        with contextlib.ExitStack() as stack:
            newest = await asyncio.to_thread(stack.enter_context, self._jobs.files.checkpoint(job.id))
            if newest is None:
                raise self._none(job)
            checkpoint, version = newest
            dataset = await asyncio.to_thread(self._datasets.get, job.specification["dataset"])
            key = f"{job.id}-{version}-{dataset.sha256}"
            try:
                await self.path(key, dataset=dataset.name, checkpoint=str(checkpoint))
            except TrainingStateInvalid:  # the training ended a moment ago
                raise self._none(job) from None
        if (png := await self.picture_png(key, 0, *PREVIEW_PICTURES)) is None:  # the folder went this very moment
            raise self._none(job)
        return png

    async def forget_job(self, job_id: str) -> None:
        await self.forget(lambda key: key.startswith(f"{job_id}-"))

    def _none(self, job: Job) -> ArtifactNotFound:
        return ArtifactNotFound(f"the job {job.id} has no checkpoint to render (any more)", field="job")


def _texts(jobs: JobStore, job_id: str) -> tuple[str, str]:
    known = jobs.get(job_id).id
    return jobs.files.journal(known), jobs.files.baselines(known)


def _curve_of(journal: str | None) -> list[CurvePoint]:
    complete = [line for line in (journal or "").splitlines(keepends=True) if line.endswith("\n")]  # one may be half
    lines = [json.loads(line) for line in complete]
    width = max(1, -(-len(lines) // MAX_POINTS))
    groups = [lines[start : start + width] for start in range(0, len(lines), width)]
    return [
        CurvePoint(
            step=int(group[-1]["step"]),
            loss=float(np.mean([line["loss"] for line in group])),
            val_psnr_db=next((line["val_psnr_db"] for line in reversed(group) if "val_psnr_db" in line), None),
        )
        for group in groups
    ]


class Thumbnails(Prepared):
    """A frame from the middle of each scene's training sweep, by the content of the scene."""

    name, what, fill = "thumbnails", "drawing the scene", staticmethod(draw_thumbnail)
    most_factor = 32  # they are small, and lists show many

    def __init__(
        self, scenes: SceneStore, catalog: SceneCatalog, settings: Settings, processes: HelperProcesses
    ) -> None:
        super().__init__(settings, processes)
        self._scenes, self._catalog = scenes, catalog

    async def key(self, scene: str) -> str:
        """Raises SceneNotFound, SceneFileInvalid, ArtifactNotFound where it does not know where it was trained."""
        header = await self._catalog.header(scene)
        if header.info.probe is None or not len(header.training_poses):
            raise ArtifactNotFound(f"the scene {scene!r} knows no view of its own", field="scene")
        return await in_own_thread(lambda: self._scenes.sha256(scene))

    async def png(self, scene: str, key: str) -> bytes:
        """Raises as `Prepared.path`."""
        path = await asyncio.to_thread(self._scenes.path, scene)
        folder = await self.path(key, scene_path=str(path))
        return await asyncio.to_thread((folder / THUMBNAIL_NAME).read_bytes)


class CompressedScenes(Prepared):
    """The compressed file of each scene, by the content of the scene."""

    name, what, fill = "compressed", "compressing the scene", staticmethod(compress_scene)

    def __init__(self, scenes: SceneStore, settings: Settings, processes: HelperProcesses) -> None:
        super().__init__(settings, processes)
        self._scenes = scenes

    async def open(self, scene: str) -> BinaryIO:
        """The file, to be read as it is now, whatever removes it meanwhile: the scene's own where that is compressed.

        Raises SceneNotFound, SceneFileInvalid, and as `Prepared.path`.
        """
        key = await in_own_thread(lambda: self._scenes.sha256(scene))
        header = await in_own_thread(lambda: self._scenes.header(scene))
        if header.is_compressed:
            return await asyncio.to_thread(self._scenes.open, scene)
        path = await asyncio.to_thread(self._scenes.path, scene)
        folder = await self.path(key, scene_path=str(path))
        try:
            return await asyncio.to_thread((folder / COMPRESSED_NAME).open, "rb")
        except FileNotFoundError:
            raise ArtifactNotFound("the compressed scene was removed as it was asked for; ask again") from None


_FORMAT = 4  # of what is kept of a comparison


@dataclass(frozen=True, kw_only=True)
class ComparedFrame:
    """How near the scene, and the classical ways (median compounding, linear between frames, the nearest frame), come.

    To a held-out frame. A figure is null until it is measured, and its picture then is there.
    """

    index: int
    frame_number: int = described("As the dataset numbers it.")
    pose: MatrixRows = described("Probe to scene, in mm.")
    confidence: float | None = described("Expected MS-SSIM; null where the scene was trained without confidence, too.")
    psnr_db: float | None
    ms_ssim: float | None
    gms: float | None
    gmsd: float | None
    histogram_distance: float | None = described("Between the grey values of both frames, in [0, 1].")
    median_psnr_db: float | None
    median_ms_ssim: float | None
    median_gms: float | None
    median_gmsd: float | None
    median_histogram_distance: float | None
    linear_psnr_db: float | None
    linear_ms_ssim: float | None
    linear_gms: float | None
    linear_gmsd: float | None
    linear_histogram_distance: float | None
    nearest_psnr_db: float | None
    nearest_ms_ssim: float | None
    nearest_gms: float | None
    nearest_gmsd: float | None
    nearest_histogram_distance: float | None


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """A scene beside the held-out frames of its dataset."""

    state: Literal["running", "ready", "failed"] = described("A failed one is tried again after a minute.")
    progress: float = described("The share of the figures that are measured, 0 to 1.")
    dataset: str = described(f"Its name; {PHANTOM}: the built-in phantom, simulated for the demo scene.")
    frames: list[ComparedFrame] = described("All held-out ones, as soon as they are known; empty where it failed.")
    reason: str | None = described("Why it failed: one sentence.")
    error: str | None = described("Why it failed: the stable reason, such as DATASET_INVALID.")


class Comparisons(Prepared):
    name, what, fill = "comparisons", "comparing the scene", staticmethod(compare)

    def __init__(
        self,
        scenes: SceneStore,
        catalog: SceneCatalog,
        datasets: DatasetStore,
        settings: Settings,
        processes: HelperProcesses,
    ) -> None:
        super().__init__(settings, processes)
        self._scenes, self._catalog, self._datasets = scenes, catalog, datasets

    async def get(self, scene: str) -> Comparison:
        """Begin the comparison unless it is there; what is known of it.

        Raises SceneNotFound, SceneFileInvalid, DatasetNotFound where the service has not the scene's dataset.
        """
        key, dataset, path = await self._wanted(scene)
        preparation = await self.prepare(key, dataset=dataset, scene_path=str(path))
        frames = await asyncio.to_thread(self._frames, key)
        scored = [value for frame in frames for name, value in vars(frame).items() if name.endswith("psnr_db")]
        error = preparation.error
        return Comparison(
            state="running" if preparation.state == "ready" and not frames else preparation.state,  # it went just now
            progress=sum(value is not None for value in scored) / max(1, len(scored)),
            dataset=dataset or PHANTOM,
            frames=frames,
            reason=None if error is None else error.detail,
            error=None if error is None else error.reason,
        )

    def _frames(self, key: str) -> list[ComparedFrame]:
        for folder in self._places(key):
            with contextlib.suppress(FileNotFoundError):
                return [ComparedFrame(**frame) for frame in json.loads((folder / FRAMES_NAME).read_bytes())]
        return []

    async def key(self, scene: str) -> str:
        return (await self._wanted(scene))[0]

    async def frame_png(self, key: str, index: int, what: str) -> bytes:
        """A picture of a held-out frame; `what` is one of `ultragray_workers.views.PICTURES`.

        Raises ArtifactNotFound where there is none (yet).
        """
        if (png := await self.picture_png(key, PICTURES.index(what), str(index))) is None:
            raise ArtifactNotFound(f"the comparison is not ready, or has no frame {index}", field="index")
        return png

    async def _wanted(self, scene: str) -> tuple[str, str | None, Path]:
        """The key, the name of the dataset (None: the built-in phantom), the file of the scene."""
        header = await self._catalog.header(scene)
        wanted = header.info.dataset_sha256
        present = await asyncio.to_thread(self._datasets.names_by_content)
        if wanted not in present and wanted != await asyncio.to_thread(simulated_sha256):
            trained_from = header.info.dataset_name
            named = "" if trained_from is None else f" ({str(trained_from)[:128]!r})"
            raise DatasetNotFound(
                f"the dataset that the scene {scene!r} was trained from{named} is not among those of the service",
                field="scene",
            )
        path = await asyncio.to_thread(self._scenes.path, scene)
        scene_sha256 = await in_own_thread(lambda: self._scenes.sha256(scene))
        return f"{_FORMAT}-{scene_sha256}-{wanted}", present.get(str(wanted)), path
