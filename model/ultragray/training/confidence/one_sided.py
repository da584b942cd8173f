"""Frames predicted from one side only: how fast anatomy changes along a sweep, where no frame was held out."""

from __future__ import annotations

import numpy as np

from ultragray.confidence.model import TERMS, terms_of
from ultragray.confidence.views import POINTS_PER_SIDE, ViewMeasures
from ultragray.datasets.sweep import Sweep
from ultragray.probe import FloatArray
from ultragray.training.confidence.fitting import Examples
from ultragray.training.confidence.held_out import path_mm
from ultragray.training.confidence.neighbours import Neighbours

MAX_FRAMES = 96  # that are predicted
BEYOND_MM = (0.0, 1.5, 3.0, 5.0, 8.0, 12.0)  # along the path: only frames farther away are used


def one_sided_examples(sweep: Sweep, hardness: FloatArray) -> Examples:
    """Some frames of a sweep, each extrapolated from those before it and from those behind it, ever farther away.

    `hardness` [F] of its frames. A sweep of one or two frames has no examples.
    """
    neighbours, path = Neighbours(sweep, MAX_FRAMES), path_mm(sweep)
    predictions = []
    for row, target in enumerate(neighbours.targets):
        for ahead in (path - path[target], path[target] - path):
            choices = (neighbours.helpers(row, beyond_mm, among=ahead > beyond_mm) for beyond_mm in BEYOND_MM)
            predictions += [neighbours.predict(row, helpers) for helpers in dict.fromkeys(choices) if len(helpers) > 1]
    if not predictions:
        return Examples(np.zeros((0, POINTS_PER_SIDE**2, 1 + TERMS)), np.zeros(0))
    names = ("nearest_mm", "distance_mm", "interpolation_mm", "angle_deg")
    distances = {name: np.concatenate([getattr(one.measures, name) for one in predictions]) for name in names}
    measures = ViewMeasures(**distances, weights=neighbours.weights[[one.row for one in predictions]])
    return Examples(terms_of(measures, hardness), np.array([one.ms_ssim for one in predictions]))
