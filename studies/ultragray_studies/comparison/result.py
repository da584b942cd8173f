"""The result of a comparison: a row a method, and what all rows share; as a JSON object and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from ultragray.contract import to_dict
from ultragray.files import require_version
from ultragray.learn.evaluation.metrics import FrameMetrics
from ultragray.learn.evaluation.scoring import Evaluation
from ultragray.learn.evaluation.speckle import FrameSpeckle, Speckle
from ultragray.learn.report.tables import DatasetFacts
from ultragray.learn.sweep import Distances, IntArray
from ultragray_studies.methods.method import Cost, Description

FORMAT_VERSION = 1
RESULT_FILE = "comparison.json"
SHORT = ", short"  # behind the title of a method that had fewer steps than its author's recipe


@dataclass(frozen=True, eq=False)
class MethodResult:
    """A method's row. One that failed has no evaluation, and says why in `failure`."""

    name: str  # as the command line calls it
    description: Description
    machine: str  # that measured it
    steps: int = 0  # 0: it learns nothing by steps
    of_steps: int | None = None  # of its author's recipe
    seconds: float = 0.0  # of the fit
    frame_ms: float = 0.0  # of one held-out frame rendered alone, the median of some
    model_bytes: int = 0
    evaluation: Evaluation | None = None
    failure: str | None = None

    @property
    def is_short(self) -> bool:
        """Whether it had fewer steps than its author's recipe."""
        return Cost(self.seconds, self.steps, self.of_steps, self.model_bytes).is_short and self.failure is None

    @property
    def title(self) -> str:
        """As tables show it: a shortened run does not bear the method's bare name."""
        return self.description.title + (SHORT if self.is_short else "")

    def to_dict(self) -> dict[str, Any]:
        """A JSON object."""
        return {
            "name": self.name,
            "title": self.title,
            "description": to_dict(self.description),
            "machine": self.machine,
            "steps": self.steps,
            "of_steps": self.of_steps,
            "seconds": self.seconds,
            "frame_ms": self.frame_ms,
            "model_bytes": self.model_bytes,
            "evaluation": None if self.evaluation is None else _evaluation_document(self.evaluation),
            "failure": self.failure,
        }

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> MethodResult:
        """Inverse of `to_dict`. Raises KeyError, TypeError or ValueError for what is none."""
        described: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value for name, value in document["description"].items()
        }
        evaluation = document["evaluation"]
        return cls(
            name=document["name"],
            description=Description(**described),
            evaluation=None if evaluation is None else _evaluation_of(evaluation),
            **{name: document[name] for name in _PLAIN},
        )


_PLAIN = ("machine", "steps", "of_steps", "seconds", "frame_ms", "model_bytes", "failure")


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
    results: tuple[MethodResult, ...] = field(default=())

    @property
    def measured(self) -> dict[str, Evaluation]:
        """The scores of those that did not fail, by name."""
        return {one.name: one.evaluation for one in self.results if one.evaluation is not None}

    @property
    def failures(self) -> dict[str, str]:
        """Why the others failed, by name."""
        return {one.name: one.failure for one in self.results if one.failure is not None}

    def to_dict(self) -> dict[str, Any]:
        """A JSON object."""
        return {
            "format_version": FORMAT_VERSION,
            "dataset": asdict(self.dataset),
            "machine": self.machine,
            "budget": self.budget,
            "budget_s": self.budget_s,
            "times": self.times,
            "seed": self.seed,
            "distances_mm": self.distances.mm.tolist(),
            "distances_deg": self.distances.deg.tolist(),
            "results": [one.to_dict() for one in self.results],
        }

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> Comparison:
        """Inverse of `to_dict`. Raises ValueError for another version, KeyError or TypeError for what is none."""
        require_version(document["format_version"], FORMAT_VERSION)
        return cls(
            dataset=DatasetFacts(**document["dataset"]),
            distances=Distances(np.array(document["distances_mm"]), np.array(document["distances_deg"])),
            results=tuple(MethodResult.from_dict(one) for one in document["results"]),
            **{name: document[name] for name in ("machine", "budget", "budget_s", "times", "seed")},
        )


def _evaluation_document(evaluation: Evaluation) -> dict[str, Any]:
    """What `Evaluation.to_dict` says, and the speckle of each frame, which its means are made of."""
    return {**evaluation.to_dict(), "frame_speckle": [asdict(one) for one in evaluation.frame_speckle]}


def _evaluation_of(document: Mapping[str, Any]) -> Evaluation:
    frames = document["frames"]
    numbers: IntArray = np.array([frame["frame"] for frame in frames], dtype=np.int64)
    metrics = [FrameMetrics(**{name: value for name, value in one.items() if name != "frame"}) for one in frames]
    speckle = [
        FrameSpeckle(_speckle_of(one["true"]), _speckle_of(one["rendered"]), one["histogram_distance"])
        for one in document["frame_speckle"]
    ]
    return Evaluation(metrics, numbers, document["ms_ssim_scales"], speckle)


def _speckle_of(document: Mapping[str, Any] | None) -> Speckle | None:
    return None if document is None else Speckle(**document)
