"""A training while it runs: its curve, and a frame as the last checkpoint renders it."""

from __future__ import annotations

import asyncio
import contextlib
import json
from dataclasses import dataclass

import numpy as np

from ultragray.contract import described
from ultragray.errors import TrainingStateInvalid
from ultragray_service.core.helper_processes import HelperProcesses
from ultragray_service.core.jobs.jobs import Jobs
from ultragray_service.settings import Settings
from ultragray_service.views.prepared import Prepared
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.errors import ArtifactNotFound
from ultragray_workers.helpers.training_preview import PICTURES, draw_preview
from ultragray_workers.jobs.files import BASELINES_NAME, JOURNAL_NAME
from ultragray_workers.jobs.store import Job, JobStore

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
        "median: compounded); empty where they were not measured."
    )


class TrainingViews(Prepared):
    """Curves and previews of trainings, running or finished. A preview is kept by job, checkpoint and dataset."""

    name, what, fill = "previews", "rendering the training as it is", staticmethod(draw_preview)

    def __init__(self, jobs: Jobs, datasets: DatasetStore, settings: Settings, processes: HelperProcesses) -> None:
        super().__init__(settings, processes)
        self._jobs = jobs
        self._datasets = datasets

    async def curve(self, job_id: str) -> TrainingCurve:
        """The training so far. Raises JobNotFound."""
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
        if (png := await self.picture_png(key, 0, *PICTURES)) is None:  # the folder went this very moment
            raise self._none(job)
        return png

    async def forget_job(self, job_id: str) -> None:
        """Remove the previews of a job."""
        await self.forget(lambda key: key.startswith(f"{job_id}-"))

    def _none(self, job: Job) -> ArtifactNotFound:
        return ArtifactNotFound(f"the job {job.id} has no checkpoint to render (any more)", field="job")


def _texts(jobs: JobStore, job_id: str) -> tuple[str | None, str | None]:
    known = jobs.get(job_id).id
    return jobs.files.text_of_run(known, JOURNAL_NAME), jobs.files.text_of_run(known, BASELINES_NAME)


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
