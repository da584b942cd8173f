"""Frames of a sweep, predicted from other frames of it by linear interpolation: no learning, small pictures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch
from torch.nn import functional

from ultragray.confidence.views import TrainingViews, ViewMeasures
from ultragray.datasets.sweep import ByteArray, IntArray, Sweep, spread_places
from ultragray.evaluation.baselines import interpolate_planes
from ultragray.evaluation.metrics import frame_metrics
from ultragray.probe import FloatArray

PICTURE_SIDE = 64  # structure smaller than its pixels is speckle
MOST_HELPERS = 16


@dataclass(frozen=True, eq=False)
class Prediction:
    """How near to a frame a prediction from other frames came, and how its pose lies to those."""

    row: int  # of Neighbours.targets
    ms_ssim: float
    measures: ViewMeasures  # of one pose; its weights are of the helpers


class Neighbours:
    """At most `most` frames of a sweep, its `targets`, each to be predicted from others."""

    def __init__(self, sweep: Sweep, most: int) -> None:
        self.targets: IntArray = spread_places(len(sweep), most)
        self._small = replace(sweep, images=_pooled(sweep.images))
        views = TrainingViews(sweep.poses, sweep.probe)
        self._distances_mm = views.mean_distances_mm(sweep.poses[self.targets], sweep.probe)  # [T, F]
        self._distances_mm[np.arange(len(self.targets)), self.targets] = -1.0  # never its own helper
        self.weights: FloatArray = views.measure(sweep.poses[self.targets], sweep.probe).weights  # [T, F]

    def helpers(self, row: int, beyond_mm: float, among: npt.NDArray[np.bool_] | None = None) -> tuple[int, ...]:
        """The MOST_HELPERS frames nearest to a target, of those farther away than this and, if given, `among` [F]."""
        distances = self._distances_mm[row]
        allowed = distances > beyond_mm if among is None else (distances > beyond_mm) & among
        order = np.argsort(distances, kind="stable")
        return tuple(order[allowed[order]][:MOST_HELPERS].tolist())

    def predict(self, row: int, helpers: tuple[int, ...]) -> Prediction:
        """Predicts a target from these frames."""
        some, target = self._small.select(list(helpers)), self.targets[row]
        pose = self._small.poses[target : target + 1]
        picture = torch.from_numpy(interpolate_planes(some, pose))
        truth = torch.from_numpy(self._small.images[target : target + 1]).float().div_(255.0)
        measures = TrainingViews(some.poses, some.probe).measure(pose, some.probe)
        return Prediction(row, frame_metrics(picture, truth)[0].ms_ssim, measures)


def _pooled(images: ByteArray) -> ByteArray:  # [F, H, W] -> [F, h, w]
    """Means of blocks, as many that the shorter side keeps PICTURE_SIDE pixels or its own."""
    height, width = images.shape[1:]
    shares = min(1.0, PICTURE_SIDE / min(height, width))
    size = (max(1, round(height * shares)), max(1, round(width * shares)))
    pooled = [functional.adaptive_avg_pool2d(torch.from_numpy(image)[None].float(), size)[0] for image in images]
    return torch.stack(pooled).round().to(torch.uint8).numpy()
