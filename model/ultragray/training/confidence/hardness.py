"""The difficulty of predicting each training view from the other frames alone."""

from __future__ import annotations

import numpy as np

from ultragray.confidence.model import NEAR_MM
from ultragray.confidence.views import TrainingViews
from ultragray.datasets.sweep import Sweep
from ultragray.probe import FloatArray
from ultragray.training.confidence.neighbours import Neighbours

MAX_FRAMES = 192  # that are predicted; the others take the hardness of their neighbours
EXCLUDED_MM = (0.0, 1.5, 3.0, 5.0)  # frames within this distance of the one that is predicted are not used
LIMITS = (0.02, 0.995)  # of an MS-SSIM whose logit is taken
SMOOTHING = 0.01


def hardness_of_views(sweep: Sweep) -> FloatArray:  # [F]
    """The shortfall of each frame's prediction by others against the usual one at such distances, in logits.

    Some frames are interpolated linearly between others, once with all of them and then without those near by; what
    the distances do not explain is the hardness, smoothed over the views around.
    """
    neighbours = Neighbours(sweep, MAX_FRAMES)
    found, measured = [], []
    for row in range(len(neighbours.targets)):
        for helpers in dict.fromkeys(neighbours.helpers(row, excluded_mm) for excluded_mm in EXCLUDED_MM):
            if len(helpers) < 2:
                continue
            prediction = neighbours.predict(row, helpers)
            measured.append(prediction.ms_ssim)
            near = prediction.measures.distance_mm[0].mean()
            between = prediction.measures.interpolation_mm[0].mean()
            found.append((row, 1.0, np.log(between + NEAR_MM), near, np.log(near + NEAR_MM)))
    if not found:
        return np.zeros(len(sweep))
    table = np.array(found)
    quality = np.clip(np.array(measured), *LIMITS)
    logits = np.log(quality / (1.0 - quality))
    terms = table[:, 1:]
    fitted = np.linalg.solve(terms.T @ terms + SMOOTHING * len(terms) * np.diag([0.0, 1.0, 1.0, 1.0]), terms.T @ logits)
    misses = terms @ fitted - logits
    rows = table[:, 0].astype(np.int64)
    targets = neighbours.targets
    counts = np.bincount(rows, minlength=len(targets))
    own = np.bincount(rows, misses, len(targets)) / np.maximum(counts, 1)  # [T]
    weights = TrainingViews(sweep.poses[targets], sweep.probe).measure(sweep.poses, sweep.probe).weights  # [F, T]
    return weights @ own
