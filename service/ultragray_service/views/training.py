"""What the console shows of a training while it runs: its curve, and a frame as the last checkpoint renders it."""

from __future__ import annotations

import asyncio
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ultragray.errors import ArtifactNotFound, TrainingStateInvalid
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.helpers.picture_stack import read_picture
from ultragray_workers.helpers.training_preview import PICTURES
from ultragray_workers.jobs.folder import JobFolder
from ultragray_workers.jobs.store import Job
from ultragray_workers.pool.process.encoding import encode_image
from ultragray_workers.pool.types import Encoding

from ..core.jobs import Jobs
from ..settings import Settings
from .prepared import PreparedFolders

FOLDER = "previews"  # of the artifact folder
MAX_POINTS = 500
_JOURNAL, _CHECKPOINT = "metrics.jsonl", "checkpoint.safetensors"  # of a run: `ultragray.training` imports torch


@dataclass(frozen=True)
class CurvePoint:
    """Neighbouring steps of a training as one: their last step, their mean loss, what was measured last in them."""

    step: int
    loss: float
    val_psnr_db: float | None


class TrainingViews:
    """Curves and previews of trainings, running or finished."""

    def __init__(self, jobs: Jobs, datasets: DatasetStore, settings: Settings, turn: asyncio.Lock) -> None:
        self._jobs = jobs
        self._datasets = datasets
        self._artifacts = settings.artifacts
        self.folders = PreparedFolders(
            settings.artifacts / FOLDER, "helpers.training_preview", "rendering the training as it is", settings, turn
        )

    async def curve(self, job_id: str) -> list[CurvePoint]:
        """At most MAX_POINTS points of the training so far; none before its first step. Raises JobNotFound."""
        job = await self._jobs.get(job_id)
        folder = JobFolder(self._artifacts, job.id)
        return await asyncio.to_thread(_curve_of, (folder.artifacts / _JOURNAL, folder.run / _JOURNAL))

    async def preview_png(self, job_id: str) -> bytes:
        """Truth, and to its right the rendering, PNG.

        Raises JobNotFound, ArtifactNotFound without a checkpoint, DatasetNotFound, and as `PreparedFolders.path`.
        """
        job = await self._jobs.get(job_id)
        await self.folders.settled(lambda key: key.startswith(f"{job_id}-"))  # one a job at a time: the newest
        checkpoint = JobFolder(self._artifacts, job.id).run / _CHECKPOINT
        version = await asyncio.to_thread(_version_of, checkpoint)
        if version is None or "dataset" not in job.specification:
            raise self._none(job)
        dataset = await asyncio.to_thread(self._datasets.get, job.specification["dataset"])
        request = {"artifact_folder": str(self._artifacts), "dataset": dataset.name, "checkpoint": str(checkpoint)}
        try:
            folder = await self.folders.path(f"{job.id}-{version}-{dataset.sha256}", request)
        except TrainingStateInvalid:  # the training ended a moment ago
            raise self._none(job) from None

        def read() -> bytes:
            pictures = [read_picture(folder, name, 0) for name in PICTURES]
            shown = [picture for picture in pictures if picture is not None]
            if len(shown) < len(PICTURES):  # the folder went this very moment
                raise self._none(job)
            return encode_image(np.concatenate(shown, axis=1), Encoding.PNG).tobytes()

        return await asyncio.to_thread(read)

    async def forget(self, job_id: str | None = None) -> None:
        """Removes the previews of a job, or of all: a training that goes on has new ones."""
        await self.folders.remove(lambda key: job_id is None or key.startswith(f"{job_id}-"))

    def _none(self, job: Job) -> ArtifactNotFound:
        return ArtifactNotFound(f"the job {job.id} has no checkpoint to render (any more)", field="job")


def _curve_of(journals: tuple[Path, ...]) -> list[CurvePoint]:
    for journal in journals:
        try:
            text = journal.read_text(encoding="utf-8")
        except FileNotFoundError:
            continue
        lines = [
            json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")
        ]  # else being written
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
    return []


def _version_of(checkpoint: Path) -> int | None:
    try:
        return checkpoint.stat().st_mtime_ns
    except FileNotFoundError:
        return None
