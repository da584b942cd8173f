"""A scene beside the held-out frames of the dataset that it was trained from."""

from __future__ import annotations

import asyncio
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ultragray.errors import ArtifactNotFound, DatasetNotFound
from ultragray.files.atomic import file_sha256
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.helpers.comparison import FRAMES_NAME
from ultragray_workers.helpers.picture_stack import read_picture
from ultragray_workers.pool.process.encoding import encode_image
from ultragray_workers.pool.types import Encoding
from ultragray_workers.scenes import FileVersion, SceneStore

from ..core.catalog import SceneCatalog
from ..core.own_thread import in_own_thread
from ..settings import Settings
from .datasets import datasets_by_content
from .prepared import Preparation, PreparedFolders

FOLDER = "comparisons"  # of the artifact folder


@dataclass(frozen=True)
class Comparison:
    """How far a comparison is; `frames` (metrics of each held-out frame) once it is ready."""

    dataset: str
    preparation: Preparation
    frames: list[dict[str, Any]]


class Comparisons:
    """Computed at the first look, and kept by the hashes of scene and dataset."""

    def __init__(
        self, scenes: SceneStore, catalog: SceneCatalog, datasets: DatasetStore, settings: Settings, turn: asyncio.Lock
    ) -> None:
        self._scenes = scenes
        self._catalog = catalog
        self._datasets = datasets
        self._artifacts = settings.artifacts
        self.folders = PreparedFolders(
            settings.artifacts / FOLDER, "helpers.comparison", "comparing the scene", settings, turn
        )
        self._hashes: dict[str, tuple[FileVersion, str]] = {}

    async def get(self, scene: str) -> Comparison:
        """Begins the comparison unless it is there; how far it is.

        Raises SceneNotFound, SceneFileInvalid, DatasetNotFound where the service has not the scene's dataset.
        """
        key, dataset, request = await self._wanted(scene)
        preparation = await self.folders.prepare(key, request)
        frames: list[dict[str, Any]] = []
        if preparation.state == "ready":
            try:
                frames = json.loads(await asyncio.to_thread((self.folders.folder / key / FRAMES_NAME).read_bytes))
            except FileNotFoundError:  # it went this very moment
                preparation = Preparation("running", 0.0)
        return Comparison(dataset, preparation, frames)

    async def key(self, scene: str) -> str:
        """Names the content of a comparison, ready or not. Raises as `get`."""
        return (await self._wanted(scene))[0]

    async def picture_png(self, key: str, index: int, what: str) -> bytes:
        """A picture of a held-out frame, PNG; `what` is one of `ultragray_workers.helpers.comparison.PICTURES`.

        Raises ArtifactNotFound where there is none (yet).
        """

        def read() -> bytes:
            picture = read_picture(self.folders.folder / key, what, index)
            if picture is None:
                raise ArtifactNotFound(f"the comparison is not ready, or has no frame {index}", field="index")
            return encode_image(picture, Encoding.PNG).tobytes()

        return await asyncio.to_thread(read)

    async def _wanted(self, scene: str) -> tuple[str, str, dict[str, Any]]:
        """Key, dataset, and what the helper process is told."""
        header = await self._catalog.header(scene)
        wanted = header.info.dataset_sha256
        present = await asyncio.to_thread(datasets_by_content, self._datasets)
        if wanted not in present:
            trained_from = header.info.dataset_name
            named = "" if trained_from is None else f" ({str(trained_from)[:128]!r})"
            raise DatasetNotFound(
                f"the dataset that the scene {scene!r} was trained from{named} is not among those of the service",
                field="scene",
            )
        path = self._scenes.path(scene)
        scene_sha256 = await in_own_thread(lambda: self._sha256(scene, path))
        request = {"artifact_folder": str(self._artifacts), "dataset": present[wanted], "scene_path": str(path)}
        return f"{scene_sha256}-{wanted}", present[wanted], request

    def _sha256(self, scene: str, path: Path) -> str:
        version = FileVersion.of(path)
        known = self._hashes.get(scene)
        if known is None or known[0] != version:
            known = self._hashes[scene] = (version, file_sha256(path))
        return known[1]
