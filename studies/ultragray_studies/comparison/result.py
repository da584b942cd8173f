"""The result of a comparison: a row a method, and what all rows share; as a JSON object, a row also back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from ultragray.learn.evaluation.metrics import FrameMetrics
from ultragray.learn.evaluation.scoring import Evaluation
from ultragray.learn.evaluation.speckle import FrameSpeckle
from ultragray.learn.report.tables import DatasetFacts
from ultragray.learn.sweep import Distances
from ultragray_studies.methods.method import Cost, Description

FORMAT_VERSION = 1
RESULT_FILE = "comparison.json"
NO_COST = Cost(0.0, 0, None, 0)
SHORT = ", short"  # behind the title of a method that had fewer steps than its author's recipe


@dataclass(frozen=True, eq=False)
class MethodResult:
    """A method's row. One that failed has no evaluation, and says why in `failure`."""

    name: str  # as the command line calls it
    description: Description
    machine: str  # that measured it
    cost: Cost = NO_COST
    frame_ms: float = 0.0  # of one held-out frame rendered alone, the median of some
    evaluation: Evaluation | None = None
    on_path: FrameMetrics | None = None  # the means on the path that neighbours agree with; None: not measured there
    failure: str | None = None

    @property
    def title(self) -> str:
        """As tables show it: a shortened run does not bear the method's bare name."""
        return self.description.title + (SHORT if self.cost.is_short else "")

    def to_dict(self) -> dict[str, Any]:
        """A JSON object. The scores of frames hold the speckle of each too, which its means are made of."""
        evaluation = self.evaluation
        return {
            "name": self.name,
            "title": self.title,
            "description": asdict(self.description),
            "machine": self.machine,
            **asdict(self.cost),
            "frame_ms": self.frame_ms,
            "evaluation": evaluation
            and {**evaluation.to_dict(), "frame_speckle": [asdict(one) for one in evaluation.frame_speckle]},
            "on_path": self.on_path and self.on_path.to_dict(),
            "failure": self.failure,
        }

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> MethodResult:
        """Inverse of `to_dict`. Raises LookupError, TypeError or ValueError for what is none."""
        evaluation = document["evaluation"]
        return cls(
            name=document["name"],
            description=_DESCRIPTION.validate_python(document["description"]),
            machine=document["machine"],
            cost=_COST.validate_python(document),
            frame_ms=document["frame_ms"],
            evaluation=evaluation
            and Evaluation(
                _METRICS.validate_python(evaluation["frames"]),
                np.array([frame["frame"] for frame in evaluation["frames"]], np.int64),
                evaluation["ms_ssim_scales"],
                _SPECKLE.validate_python(evaluation["frame_speckle"]),
            ),
            on_path=None if document.get("on_path") is None else _MEAN.validate_python(document["on_path"]),
            failure=document["failure"],
        )


_DESCRIPTION, _COST = TypeAdapter(Description), TypeAdapter(Cost)
_MEAN = TypeAdapter(FrameMetrics)
_METRICS, _SPECKLE = TypeAdapter(list[FrameMetrics]), TypeAdapter(list[FrameSpeckle])


@dataclass(frozen=True, eq=False)
class Comparison:
    """Methods side by side on the held-out frames of one dataset."""

    dataset: DatasetFacts
    machine: str
    budget: str  # of BudgetKind
    times: float
    seed: int
    distances: Distances
    budget_s: float | None = None  # the equal time, before `times`; None where nothing had to learn within one
    results: tuple[MethodResult, ...] = ()

    @property
    def measured(self) -> dict[str, Evaluation]:
        """The scores of those that did not fail, by name."""
        return {one.name: one.evaluation for one in self.results if one.evaluation is not None}

    @property
    def has_path(self) -> bool:
        """Whether some were measured on the path that neighbouring frames agree with, too."""
        return any(one.on_path is not None for one in self.results)

    @property
    def failures(self) -> dict[str, str]:
        """Why the others failed, by name."""
        return {one.name: one.failure for one in self.results if one.failure is not None}

    def to_dict(self) -> dict[str, Any]:
        """A JSON object."""
        return {
            "format_version": FORMAT_VERSION,
            "dataset": asdict(self.dataset),
            **{name: getattr(self, name) for name in ("machine", "budget", "budget_s", "times", "seed")},
            "distances_mm": self.distances.mm.tolist(),
            "distances_deg": self.distances.deg.tolist(),
            "results": [one.to_dict() for one in self.results],
        }
