"""Tables of what was measured, as texts: metrics with ranks, speckle, the facts of a dataset. Free of torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple, dataclass, field
from typing import TYPE_CHECKING

from ultragray.learn.sweep import Dataset

if TYPE_CHECKING:
    from ultragray.learn.evaluation.metrics import FrameMetrics
    from ultragray.learn.evaluation.scoring import Evaluation
    from ultragray.learn.evaluation.speckle import Speckle, SpeckleSummary


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


@dataclass(frozen=True)
class Row:
    """A line of a table of metrics. `cells` pairs each text with whether it is the best of its column.

    A line with a `failure` has that in their place.
    """

    name: str
    cells: list[tuple[str, bool]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    failure: str | None = None
    anchor: str = ""  # of what the page says of the method


def metric_rows(evaluations: Mapping[str, Evaluation], notes: Mapping[str, list[str]] | None = None) -> list[Row]:
    """One row a method with mean ± standard deviation, the best mean of each column marked."""
    ranks = rank(evaluations)
    rows = []
    for name, evaluation in evaluations.items():
        mean, std = evaluation.mean.to_dict(), evaluation.std.to_dict()
        cells = [
            (
                f"{shown_value(metric.name, mean[metric.name])} ± {shown_value(metric.name, std[metric.name])}",
                len(evaluations) > 1 and ranks[name].by_metric[metric.name] == 1,
            )
            for metric in METRICS
        ]
        rows.append(Row(name, cells, (notes or {}).get(name, [])))
    return rows


def path_row(name: str, on_path: FrameMetrics) -> Row:
    """The row of a method's means on the path, which has no part in the ranks."""
    means = on_path.to_dict()
    return Row(f"{name}, on the path", [(shown_value(metric.name, means[metric.name]), False) for metric in METRICS])


def rank_rows(evaluations: Mapping[str, Evaluation]) -> list[Row]:
    """One row a method with its place by each metric, and the mean of them; the first of each column marked."""
    ranks = rank(evaluations)
    means = {name: f"{ranking.mean:.2f}" for name, ranking in ranks.items()}
    best = min(means.values(), key=float, default="")
    return [
        Row(name, [*((str(place), place == 1) for place in places.by_metric.values()), (mean, mean == best)])
        for (name, places), mean in zip(ranks.items(), means.values(), strict=True)
    ]


def speckle_rows(evaluations: Mapping[str, Evaluation]) -> list[tuple[str, list[str]]]:
    """The statistics of speckle: the true frames, then one row a method, as texts."""
    summaries = speckle_summaries(evaluations)
    if not summaries:
        return []
    true = next(iter(summaries.values())).true
    return [
        ("true frames", [*_speckle_texts(true), ""]),
        *((name, [*_speckle_texts(one.rendered), f"{one.histogram_distance:.4f}"]) for name, one in summaries.items()),
    ]


def speckle_summaries(evaluations: Mapping[str, Evaluation]) -> dict[str, SpeckleSummary]:
    """By what was measured: each method, and after it the same with natural speckle where that is known."""
    summaries = {}
    for name, evaluation in evaluations.items():
        summaries[name] = evaluation.speckle
        if evaluation.natural is not None:
            summaries[f"{name}, natural speckle"] = evaluation.natural
    return summaries


SPECKLE_COLUMNS = ("contrast", "axial, mm", "lateral, mm", "axial gradient", "lateral gradient")


def _speckle_texts(speckle: Speckle | None) -> list[str]:
    return ["–"] * len(SPECKLE_COLUMNS) if speckle is None else [f"{value:.3f}" for value in astuple(speckle)]


@dataclass(frozen=True)
class DatasetFacts:
    """What pages and results say of a dataset."""

    name: str
    sha256: str
    probe: str
    train_frames: int
    val_frames: int
    height: int
    width: int
    axial_mm: float  # of a pixel in the middle of the image
    lateral_mm: float

    @classmethod
    def of(cls, dataset: Dataset) -> DatasetFacts:
        train = dataset.train
        counts = (len(train), len(dataset.val), train.height, train.width)
        return cls(dataset.name, dataset.sha256, str(dataset.probe), *counts, *train.pixel_mm)

    @property
    def image_words(self) -> dict[str, str]:
        return {
            "Image": f"{self.height} rows x {self.width} scan lines",
            "Pixel": f"{self.axial_mm:.2f} mm axial, {self.lateral_mm:.2f} mm lateral in the middle",
            "Probe": self.probe,
        }
