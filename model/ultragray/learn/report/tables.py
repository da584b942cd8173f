"""The metrics that tables show, the places of methods by each of them, and the mean of these."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ultragray.learn.evaluation.scoring import Evaluation


@dataclass(frozen=True)
class Metric:
    """A field of FrameMetrics."""

    name: str
    label: str
    digits: int
    sign: int = 1  # -1 where less is better

    @property
    def heading(self) -> str:
        return f"{self.label} {'↑' if self.sign > 0 else '↓'}"


METRICS = (
    Metric("psnr_db", "PSNR, dB", 2),
    Metric("ms_ssim", "MS-SSIM", 3),
    Metric("gms", "GMS", 3),
    Metric("gmsd", "GMSD", 3, sign=-1),
)
LABELS = {metric.name: metric.label for metric in METRICS}
_DIGITS = {metric.name: metric.digits for metric in METRICS}


def shown_value(name: str, value: float) -> str:
    """A value as tables show it; two that read the same count as equal."""
    return f"{value:.{_DIGITS[name]}f}"


@dataclass(frozen=True)
class Ranks:
    """The places of a method, 1 the best."""

    by_metric: Mapping[str, int]

    @property
    def mean(self) -> float:
        return sum(self.by_metric.values()) / len(self.by_metric)


def rank(evaluations: Mapping[str, Evaluation]) -> dict[str, Ranks]:
    """The ranks of each method by its means over the frames; those whose figures read the same share the better place.

    A method's place is 1 plus the number of those that are better.
    """
    means = {name: evaluation.mean.to_dict() for name, evaluation in evaluations.items()}

    def goodness(name: str, metric: Metric) -> float:
        return metric.sign * float(shown_value(metric.name, means[name][metric.name]))

    return {
        name: Ranks(
            {
                metric.name: 1 + sum(goodness(other, metric) > goodness(name, metric) for other in means)
                for metric in METRICS
            }
        )
        for name in evaluations
    }


def by_mean_rank(evaluations: Mapping[str, Evaluation]) -> list[str]:
    """The names, best mean rank first; those of the same stay in their order."""
    ranks = rank(evaluations)
    return sorted(evaluations, key=lambda name: ranks[name].mean)
