"""Comparison and evaluation: methods side by side, or a scene, are scored on the held-out frames of a dataset."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ultragray.contract import described, kind_field
from ultragray.learn.evaluation.methods import ComparisonSettings
from ultragray_workers.jobs.kinds.base import Specification, Surroundings


@dataclass(frozen=True)
class CompareJob(ComparisonSettings, Specification):
    """Methods are fitted to a dataset, each within the same budget, and scored on its held-out frames.

    The means of each method are the metrics of the job, such as linear_psnr_db; comparison.html, comparison.json and
    comparison.tex have the rest. Raises InvalidArgument.
    """

    dataset: str = described("Name of an uploaded dataset, with held-out frames.", kw_only=True)
    kind: Literal["compare"] = kind_field("compare")

    has_checkpoints = True
    needs_dataset = "dataset"

    def check(self, surroundings: Surroundings) -> None:
        self.plugin()


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
