"""The difficulty of predicting each training view from the other frames alone: no learning, small pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch.nn import functional

from ...confidence.model import NEAR_MM
from ...confidence.views import TrainingViews
from ...datasets.sweep import ByteArray, Sweep, spread_places
from ...evaluation.baselines import interpolate_planes
from ...evaluation.metrics import frame_metrics
from ...probe import FloatArray

PICTURE_SIDE = 64  # structure smaller than its pixels is speckle
MAX_FRAMES = 192  # that are predicted; the others take the hardness of their neighbours
NEIGHBOURS = 16
EXCLUDED_MM = (0.0, 1.5, 3.0, 5.0)  # frames within this distance of the one that is predicted are not used
LIMITS = (0.02, 0.995)  # of an MS-SSIM whose logit is taken
SMOOTHING = 0.01


def hardness_of_views(sweep: Sweep) -> FloatArray:  # [F]
    """The shortfall of each frame's prediction by others against the usual one at such distances, in logits.

    Some frames are interpolated linearly between others (`baselines.interpolate_planes`), once with all of them and
    then without those near by; what the distances do not explain is the hardness, smoothed over the views around.
    """
    small = replace(sweep, images=_pooled(sweep.images))
    views = TrainingViews(sweep.poses, sweep.probe)
    targets = spread_places(len(sweep), MAX_FRAMES)
    distances = views.mean_distances_mm(sweep.poses[targets], sweep.probe)  # [T, F]
    distances[np.arange(len(targets)), targets] = -1.0
    found, measured = [], []
    for row, target in enumerate(targets):
        used: tuple[int, ...] | None = None
        for excluded_mm in EXCLUDED_MM:
            order = np.argsort(distances[row], kind="stable")
            helpers = order[distances[row][order] > excluded_mm][:NEIGHBOURS]
            if len(helpers) < 2 or tuple(helpers) == used:
                continue
            used = tuple(helpers)
            pose = sweep.poses[target : target + 1]
            picture = interpolate_planes(small.select(helpers), pose)
            truth = torch.from_numpy(small.images[target : target + 1]).float().div_(255.0)
            measured.append(frame_metrics(torch.from_numpy(picture), truth)[0].ms_ssim)
            measures = TrainingViews(sweep.poses[helpers], sweep.probe).measure(pose, sweep.probe)
            near, between = measures.distance_mm[0].mean(), measures.interpolation_mm[0].mean()
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
    counts = np.bincount(rows, minlength=len(targets))
    own = np.bincount(rows, misses, len(targets)) / np.maximum(counts, 1)  # [T]
    weights = TrainingViews(sweep.poses[targets], sweep.probe).measure(sweep.poses, sweep.probe).weights  # [F, T]
    return weights @ own


def _pooled(images: ByteArray) -> ByteArray:  # [F, H, W] -> [F, h, w]
    """Means of blocks, as many that the shorter side keeps PICTURE_SIDE pixels or its own."""
    height, width = images.shape[1:]
    shares = min(1.0, PICTURE_SIDE / min(height, width))
    size = (max(1, round(height * shares)), max(1, round(width * shares)))
    pooled = [functional.adaptive_avg_pool2d(torch.from_numpy(image)[None].float(), size)[0] for image in images]
    return torch.stack(pooled).round().to(torch.uint8).numpy()
