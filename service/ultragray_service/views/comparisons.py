"""A scene beside the held-out frames of the dataset that it was trained from."""

from __future__ import annotations

import asyncio
import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

from ultragray.contract import described
from ultragray.datasets.source import PHANTOM
from ultragray.demo import DEMO_FILE
from ultragray.scene_info import read_header
from ultragray_service.core.catalog import SceneCatalog
from ultragray_service.core.helper_processes import HelperProcesses
from ultragray_service.core.own_thread import in_own_thread
from ultragray_service.core.poses import MatrixRows
from ultragray_service.settings import Settings
from ultragray_service.views.prepared import Preparation, Prepared
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.errors import ArtifactNotFound, DatasetNotFound
from ultragray_workers.helpers.comparison import FRAMES_NAME, compare
from ultragray_workers.scenes import SceneStore

_FORMAT = 3  # of what is kept of a comparison


@dataclass(frozen=True, kw_only=True)
class ComparedFrame:
    """How near the scene, and the classical ways (median compounding, linear between frames, the nearest frame), come.

    To a held-out frame.
    """

    index: int
    frame_number: int = described("As the dataset numbers it.")
    pose: MatrixRows = described("Probe to scene, in mm.")
    confidence: float | None = described("Expected MS-SSIM; null where the scene was trained without confidence.")
    psnr_db: float
    ms_ssim: float
    gms: float
    gmsd: float
    histogram_distance: float = described("Between the grey values of both frames, in [0, 1].")
    median_psnr_db: float
    median_ms_ssim: float
    median_gms: float
    median_gmsd: float
    median_histogram_distance: float
    linear_psnr_db: float
    linear_ms_ssim: float
    linear_gms: float
    linear_gmsd: float
    linear_histogram_distance: float
    nearest_psnr_db: float
    nearest_ms_ssim: float
    nearest_gms: float
    nearest_gmsd: float
    nearest_histogram_distance: float


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """A scene beside the held-out frames of its dataset."""

    state: Literal["running", "ready", "failed"] = described("A failed one is tried again after a minute.")
    progress: float = described("0 to 1.")
    dataset: str = described(f"Its name; {PHANTOM}: the built-in phantom, simulated for the demo scene.")
    frames: list[ComparedFrame] = described("Empty until it is ready.")
    reason: str | None = described("Why it failed: one sentence.")
    error: str | None = described("Why it failed: the stable reason, such as DATASET_INVALID.")


class Comparisons(Prepared):
    """Computed at the first look, and kept by the hashes of scene and dataset."""

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
        self._scenes = scenes
        self._catalog = catalog
        self._datasets = datasets

    async def get(self, scene: str) -> Comparison:
        """Begin the comparison unless it is there; how far it is.

        Raises SceneNotFound, SceneFileInvalid, DatasetNotFound where the service has not the scene's dataset.
        """
        key, dataset, path = await self._wanted(scene)
        preparation = await self.prepare(key, dataset=dataset, scene_path=str(path))
        frames: list[ComparedFrame] = []
        if preparation.state == "ready":
            try:
                document = await asyncio.to_thread((self.folder / key / FRAMES_NAME).read_bytes)
                frames = [ComparedFrame(**frame) for frame in json.loads(document)]
            except FileNotFoundError:  # it went this very moment
                preparation = Preparation("running", 0.0)
        reason, error = (preparation.error.detail, preparation.error.reason) if preparation.error else (None, None)
        return Comparison(
            state=preparation.state,
            progress=preparation.progress,
            dataset=dataset or PHANTOM,
            frames=frames,
            reason=reason,
            error=error,
        )

    async def key(self, scene: str) -> str:
        """The key of a comparison, ready or not. Raises as `get`."""
        return (await self._wanted(scene))[0]

    async def frame_png(self, key: str, index: int, what: str) -> bytes:
        """A picture of a held-out frame; `what` is one of `ultragray_workers.helpers.comparison.PICTURES`.

        Raises ArtifactNotFound where there is none (yet).
        """
        if (png := await self.picture_png(key, index, what)) is None:
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


@cache
def simulated_sha256() -> str | None:
    """Of the dataset that the demo scene was trained from: it needs no upload, since it can be simulated."""
    return read_header(DEMO_FILE).info.dataset_sha256
