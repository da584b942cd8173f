"""Comparison: methods are fitted to a dataset and scored on its held-out frames, side by side."""

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
