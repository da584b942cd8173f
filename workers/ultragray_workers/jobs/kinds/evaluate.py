"""Evaluation: a scene is scored on the held-out frames of a dataset."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ultragray.contract import described, kind_field
from ultragray_workers.jobs.kinds.base import Specification


@dataclass(frozen=True)
class EvaluateJob(Specification):
    """A scene is scored on the held-out frames of a dataset: PSNR, MS-SSIM, GMS and GMSD.

    At the poses of the dataset, and on the path that the scene was trained on. The means are the metrics of the job;
    evaluation.json has those of every frame. Raises InvalidArgument.
    """

    dataset: str = described("Name of an uploaded dataset, which need not be the one that the scene was trained from.")
    scene: str = described("Name of a scene.")
    baselines: bool = described(
        "Also score classical predictions from the training frames: compounding, and blends of neighbours.", False
    )
    register: bool = described("Also move each frame by one half of it, and score the other half: minutes.", False)
    kind: Literal["evaluate"] = kind_field("evaluate")

    run_module = "ultragray_workers.jobs.kinds.evaluate_run"
    needs_dataset = "dataset"
    needs_scene = "scene"
