"""The classical baselines as methods: they learn nothing, and render from the training frames."""

from __future__ import annotations

import time
from dataclasses import dataclass

from ultragray.errors import InvalidArgument
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.learn.evaluation.baselines import (
    IN_TIME,
    FrameArray,
    Volume,
    affordable_voxel_mm,
    compound,
    predict,
    predict_held_out,
)
from ultragray.learn.prediction import NeighboursInTime
from ultragray.learn.sweep import Dataset, Sweep
from ultragray_studies.methods.method import Budget, Cost, Description, FitRun, Fitted, Method

PAPER_VOXEL_MM = 0.25  # of the compounding that the UltraG-Ray paper compares with


@dataclass(frozen=True)
class Compounding(Method):
    """A volume of voxels, each the median, mean or maximum of the pixels that fall into it, re-sliced trilinearly."""

    fold: str  # of ultragray.learn.evaluation.baselines.METHODS
    voxel_mm: float | None = None  # None: 0.5 mm, or what fits into memory

    @property
    def name(self) -> str:  # type: ignore[override]
        return self.fold if self.voxel_mm is None else f"{self.fold}-{self.voxel_mm:g}mm"

    def describe(self) -> Description:
        size = "0.5 mm" if self.voxel_mm is None else f"{self.voxel_mm:g} mm"
        return Description(
            title=f"{self.fold} compounding, {size}",
            source="Gobbi and Peters, 2002; ultragray.learn.evaluation.baselines",
            summary=f"Each voxel of {size} keeps the {self.fold} of the pixels that fall into it; gaps are filled.",
            choices=() if self.voxel_mm else ("Voxels are larger where 0.5 mm would not fit into memory.",),
        )

    def fit(self, dataset: Dataset, budget: Budget, run: FitRun | None = None) -> _Compounded:
        began_s = time.perf_counter()
        voxel_mm = affordable_voxel_mm(dataset.train) if self.voxel_mm is None else self.voxel_mm
        volume = compound(dataset.train, self.fold, voxel_mm)
        size = volume.values.numel() * (volume.values.element_size() + 1)
        return _Compounded(volume, Cost(time.perf_counter() - began_s, 0, None, size))

    def predict_on_path(self, dataset: Dataset, placed: Dataset, fitted: Fitted) -> FrameArray:
        return self.fit(placed, Budget.author()).predict(placed.val)


@dataclass(frozen=True, eq=False)
class _Compounded(Fitted):
    volume: Volume
    cost: Cost

    def render(self, probe: Probe, poses: FloatArray, height: int, width: int) -> FrameArray:
        return self.volume.reslice(probe, poses, height, width)


@dataclass(frozen=True)
class FromFrames(Method):
    """A frame taken from the training frames at once: linear between those that enclose a pixel, or the nearest."""

    name: str  # linear or nearest

    def describe(self) -> Description:
        titles = {"linear": "linear between frames", "nearest": "nearest training frame"}
        summaries = {
            "linear": "Each pixel from the nearest frame on either side of it, by the distances to their planes.",
            "nearest": "The training frame whose corners lie nearest on average, as it is.",
        }
        return Description(titles[self.name], "ultragray.learn.evaluation.baselines", summaries[self.name])

    def fit(self, dataset: Dataset, budget: Budget, run: FitRun | None = None) -> _Frames:
        return _Frames(dataset.train, self.name, Cost(0.0, 0, None, dataset.train.images.nbytes))

    def predict_on_path(self, dataset: Dataset, placed: Dataset, fitted: Fitted) -> FrameArray:
        return predict(placed.train, placed.val.poses, self.name)


@dataclass(frozen=True, eq=False)
class _Frames(Fitted):
    sweep: Sweep
    method: str
    cost: Cost

    def render(self, probe: Probe, poses: FloatArray, height: int, width: int) -> FrameArray:
        """Raises InvalidArgument for another probe or image size than the sweep's: its frames are shown as they are."""
        own = self.sweep.probe, self.sweep.height, self.sweep.width
        if (probe, height, width) != own:
            raise InvalidArgument(f"{self.method} renders frames of its own sweep only, {own}", field="probe")
        return predict(self.sweep, poses, self.method)


@dataclass(frozen=True)
class InTime(Method):
    """A held-out frame as the blend of the training frames before and after it, whatever the poses say."""

    name = IN_TIME

    def describe(self) -> Description:
        return Description(
            "neighbours in time",
            "ultragray.learn.evaluation.baselines",
            "Each pixel from the same pixel of the training frames before and after it in its recording, by their "
            "times: what poses are worth shows beside it.",
            choices=("At an end of the recording the one neighbour.", "It has frames of its own recording only."),
        )

    def fit(self, dataset: Dataset, budget: Budget, run: FitRun | None = None) -> _BlendsInTime:
        """Raises DatasetInvalid where held-out frames have no neighbours in time."""
        NeighboursInTime.of(dataset)
        return _BlendsInTime(dataset.train, Cost(0.0, 0, None, dataset.train.images.nbytes))


@dataclass(frozen=True, eq=False)
class _BlendsInTime(Fitted):
    sweep: Sweep
    cost: Cost

    def render(self, probe: Probe, poses: FloatArray, height: int, width: int) -> FrameArray:
        """Raises InvalidArgument: a pose has no neighbours in time."""
        raise InvalidArgument(
            f"{IN_TIME} predicts frames of its own recording by their times, not poses", field="poses"
        )

    def predict(self, sweep: Sweep) -> FrameArray:
        return predict_held_out(Dataset(self.sweep.source, self.sweep, sweep), IN_TIME)
