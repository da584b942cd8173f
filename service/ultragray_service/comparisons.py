"""A scene beside the held-out frames of the dataset that it was trained from."""

from __future__ import annotations

import asyncio
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ultragray.errors import ArtifactNotFound, DatasetNotFound, UltragrayError
from ultragray.files import file_sha256
from ultragray_workers.comparison import FRAMES_NAME
from ultragray_workers.dataset_store import DatasetStore
from ultragray_workers.encoding import encode_image
from ultragray_workers.picture_stack import SUFFIX, read_picture
from ultragray_workers.scenes import FileVersion, SceneStore
from ultragray_workers.types import Encoding

from .catalog import SceneCatalog
from .prepared import Preparation, PreparedFolders
from .settings import Settings

FOLDER = "comparisons"  # of the artifact folder


@dataclass(frozen=True)
class Comparison:
    """How far a comparison is; `frames` (metrics of each held-out frame) once it is ready."""

    dataset: str
    preparation: Preparation
    frames: list[dict[str, Any]]


class Comparisons:
    """Computed at the first look, and kept by the hashes of scene and dataset."""

    def __init__(self, scenes: SceneStore, catalog: SceneCatalog, datasets: DatasetStore, settings: Settings) -> None:
        self._scenes = scenes
        self._catalog = catalog
        self._datasets = datasets
        self._artifacts = settings.artifacts
        self.folders = PreparedFolders(settings.artifacts / FOLDER, "comparison", "comparing the scene", settings)
        self._hashes: dict[str, tuple[FileVersion, str]] = {}

    async def get(self, scene: str) -> Comparison:
        """Begins the comparison unless it is there; how far it is.

        Raises SceneNotFound, SceneFileInvalid, DatasetNotFound where the service has not the scene's dataset.
        """
        key, dataset, request = await self._wanted(scene)
        preparation = await self.folders.prepare(key, request)
        frames: list[dict[str, Any]] = []
        if preparation.state == "ready":
            frames = json.loads(await asyncio.to_thread((self.folders.folder / key / FRAMES_NAME).read_bytes))
        return Comparison(dataset, preparation, frames)

    async def picture_png(self, scene: str, index: int, what: str) -> bytes:
        """A picture of a held-out frame, PNG; `what` is one of `ultragray_workers.comparison.PICTURES`.

        Raises as `get`, and ArtifactNotFound where there is none (yet).
        """
        key, _, _ = await self._wanted(scene)

        def read() -> bytes:
            picture = read_picture(self.folders.folder / key / f"{what}{SUFFIX}", index)
            if picture is None:
                raise ArtifactNotFound(
                    f"the comparison of the scene {scene!r} is not ready, or has no frame {index}", field="index"
                )
            return encode_image(picture, Encoding.PNG).tobytes()

        return await asyncio.to_thread(read)

    async def _wanted(self, scene: str) -> tuple[str, str, dict[str, Any]]:
        """Key, dataset, and what the helper process is told."""
        header = await self._catalog.header(scene)
        wanted = header.info.dataset_sha256
        dataset = None if wanted is None else await asyncio.to_thread(self._dataset_of, wanted)
        if dataset is None:
            trained_from = header.info.dataset_name
            named = "" if trained_from is None else f" ({str(trained_from)[:128]!r})"
            raise DatasetNotFound(
                f"the dataset that the scene {scene!r} was trained from{named} is not among those of the service",
                field="scene",
            )
        path = self._scenes.path(scene)
        scene_sha256 = await asyncio.to_thread(self._sha256, scene, path)
        request = {"artifact_folder": str(self._artifacts), "dataset": dataset, "scene_path": str(path)}
        return f"{scene_sha256}-{wanted}", dataset, request

    def _dataset_of(self, sha256: str) -> str | None:
        for name in self._datasets.names():
            try:
                if self._datasets.get(name).sha256 == sha256:
                    return name
            except UltragrayError:  # deleted a moment ago, or a damaged manifest
                continue
        return None

    def _sha256(self, scene: str, path: Path) -> str:
        version = FileVersion.of(path)
        known = self._hashes.get(scene)
        if known is None or known[0] != version:
            known = self._hashes[scene] = (version, file_sha256(path))
        return known[1]
