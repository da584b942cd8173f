"""The fit of a scene's confidence and uncertainty, by a shorter training that holds frames out. Called at a run's end.

Expected is MS-SSIM = black + (1 − black)·mean over points of σ(w · terms), σ the logistic curve: `terms` grow with the
distance of a point to the views around it, with the gap between these, and with how hard those views are to predict
from their neighbours (`hardness_of_views`). Four kinds of evidence determine w: frames that the shorter training did
not see, some that it did, frames extrapolated from one side of the sweep, and a prior about w from ten scenes, which
decides what a scene's own frames leave open. The least squares are solved by Levenberg-Marquardt steps with w ≥ 0 but
for its first entry. `fit_uncertainty` explains squared errors of pixels by the same distances.

In reading order: which frames are held out, predictions of frames from one side, hardness, the fit of the weights,
uncertainty, and `fit_confidence`, which calls all of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import torch
from torch.nn import functional

from ultragray.geometry.probe import FloatArray
from ultragray.geometry.rotations import rotation_angles_deg
from ultragray.learn.evaluation import metrics
from ultragray.learn.evaluation.baselines import interpolate_planes
from ultragray.learn.evaluation.scoring import evaluate, evaluate_frames, render_sweep, rendered_parts
from ultragray.learn.sweep import ByteArray, Dataset, IntArray, Sweep, spread_places
from ultragray.learn.training.config import TrainingConfig
from ultragray.rendering.derived import CELLS, in_cells, variance_terms, view_distances
from ultragray.rendering.derived import POINTS_PER_SIDE as DEVIATION_POINTS
from ultragray.rendering.outputs import UNCERTAINTY
from ultragray.scene.confidence import (
    DEPTHS,
    FAR_MM,
    NEAR_MM,
    POINTS_PER_SIDE,
    TERMS,
    ConfidenceModel,
    DepthBands,
    Support,
    TrainingViews,
    Uncertainty,
    ViewMeasures,
    logistic,
    predicted,
    supported,
    terms_of,
    within,
)
from ultragray.scene.gaussians import GaussianScene

# Stretches of the sweep's path, as shares of its length: first and last, then gaps of several widths.
STRETCHES = ((0.0, 0.06), (0.20, 0.23), (0.34, 0.39), (0.48, 0.57), (0.68, 0.69), (0.89, 1.0))
TURNED = (0.73, 0.83)  # in which frames are left out by their tilt instead
TURNED_SHARE = 1 / 3
LEAST_TILT_DEG = 2.0  # smaller differences are unsteadiness of the hand
SINGLE_EVERY = 12  # of the frames that are left
LEAST_KEPT = 4
MAX_SHARE = 0.45
LEAST_HELD_OUT = 3  # fewer tell nothing


def held_out_frames(sweep: Sweep) -> IntArray:  # [H] places, ascending
    """Frames of some stretches of the path, the most tilted ones of another stretch, and single ones; maybe none.

    All frames of a stretch are left out, whichever pass of the probe they come from. At most MAX_SHARE of the frames
    and never more than leave LEAST_KEPT: single frames are given up first, then the last ones of the path.
    """
    along = path_mm(sweep)
    path = along / (float(np.ptp(along)) or 1.0)
    chosen = np.zeros(len(sweep), bool)
    for first, last in STRETCHES:
        chosen |= (path >= first) & (path <= last)
    stretch = np.flatnonzero((path > TURNED[0]) & (path < TURNED[1]) & ~chosen)
    chosen[stretch[_most_tilted(sweep.poses[stretch])]] = True
    stretches = np.flatnonzero(chosen)
    rest = np.flatnonzero(~chosen)
    singles = rest[np.argsort(path[rest], kind="stable")][SINGLE_EVERY // 2 :: SINGLE_EVERY]
    wanted = np.concatenate([stretches[np.argsort(path[stretches], kind="stable")], singles])
    allowed = min(math.floor(MAX_SHARE * len(sweep)), len(sweep) - LEAST_KEPT)
    return np.sort(wanted[: max(allowed, 0)]).astype(np.int64)


def path_mm(sweep: Sweep) -> FloatArray:  # [F], from 0 on
    """The place of each frame along the direction in which the middles of the images spread most."""
    middles = sweep.corners_mm().mean(axis=1)
    offsets = middles - middles.mean(axis=0)
    _, _, directions = np.linalg.svd(offsets, full_matrices=False)
    places: FloatArray = offsets @ directions[0]
    places -= places.min()
    return places


def _most_tilted(poses: FloatArray) -> IntArray:  # [F, 4, 4] -> [≤ F]
    """Those turned farthest to one side of the others, where the orientations differ by LEAST_TILT_DEG or more."""
    if len(poses) < 3:
        return np.zeros(0, np.int64)
    angles = rotation_angles_deg(poses, poses)
    farthest = angles[int(np.unravel_index(angles.argmax(), angles.shape)[0])]
    if farthest.max() < LEAST_TILT_DEG:
        return np.zeros(0, np.int64)
    count = max(1, round(TURNED_SHARE * len(poses)))
    return np.argsort(farthest, kind="stable")[:count].astype(np.int64)


PICTURE_SIDE = 64  # structure smaller than its pixels is speckle
MOST_HELPERS = 16


@dataclass(frozen=True, eq=False)
class Prediction:
    """How near to a frame a prediction from other frames came, and how its pose lies to those."""

    target: int  # its place in the sweep
    is_nearest: bool  # whether from the nearest frames on a side
    ms_ssim: float
    measures: ViewMeasures  # of one pose; its weights are of the helpers


class Neighbours:
    """At most `most` frames of a sweep, its `targets`, each to be predicted from others."""

    def __init__(self, sweep: Sweep, most: int) -> None:
        self.targets: IntArray = spread_places(len(sweep), most)
        self._small = replace(sweep, images=_pooled(sweep.images))
        views = TrainingViews(sweep.poses, sweep.probe)
        self._distances_mm = views.mean_distances_mm(sweep.poses[self.targets], sweep.probe)  # [T, F]

    def helpers(self, row: int, among: npt.NDArray[np.bool_]) -> tuple[int, ...]:  # [F]
        """The MOST_HELPERS frames nearest to a target, of those `among` which it is not."""
        order = np.argsort(self._distances_mm[row], kind="stable")
        return tuple(order[among[order]][:MOST_HELPERS].tolist())

    def predict(self, rows: Sequence[int], helpers: Sequence[tuple[int, ...]]) -> list[tuple[float, ViewMeasures]]:
        """The MS-SSIM of small pictures of targets, each made from its helpers, and how its pose lies to those."""
        small, targets = self._small, self.targets[list(rows)]
        frames = np.full((len(rows), MOST_HELPERS), -1)
        for some, of in zip(frames, helpers, strict=True):
            some[: len(of)] = of
        pictures = torch.from_numpy(interpolate_planes(small, small.poses[targets], frames))
        truth = torch.from_numpy(small.images[targets]).float().div_(255.0)
        measures = [
            TrainingViews(small.poses[list(of)], small.probe).measure(small.poses[[target]], small.probe)
            for target, of in zip(targets, helpers, strict=True)
        ]
        return list(zip(metrics.ms_ssim(pictures, truth), measures, strict=True))


def _pooled(images: ByteArray) -> ByteArray:  # [F, H, W] -> [F, h, w]
    """Means of blocks, as many that the shorter side keeps PICTURE_SIDE pixels or its own."""
    height, width = images.shape[1:]
    shares = min(1.0, PICTURE_SIDE / min(height, width))
    size = (max(1, round(height * shares)), max(1, round(width * shares)))
    pooled = [functional.adaptive_avg_pool2d(torch.from_numpy(image)[None].float(), size)[0] for image in images]
    return torch.stack(pooled).round().to(torch.uint8).numpy()


MOST_TARGETS = 192  # frames that are predicted
PREDICTED_AT_ONCE = 64  # one by one, threads took most of the time to find each other
BEYOND_MM = (0.0, 1.5, 3.0, 5.0, 8.0, 12.0)  # along the path: only frames farther away are used


def one_sided(sweep: Sweep) -> list[Prediction]:
    """Some frames of a sweep, each extrapolated from those before it and from those behind it, ever farther away.

    A sweep of one or two frames has none.
    """
    neighbours, path = Neighbours(sweep, MOST_TARGETS), path_mm(sweep)
    cases = []  # row, helpers, whether they are the nearest on a side
    for row, target in enumerate(neighbours.targets):
        for ahead in (path - path[target], path[target] - path):
            choices = (neighbours.helpers(row, ahead > beyond_mm) for beyond_mm in BEYOND_MM)
            cases += [
                (row, helpers, not number) for number, helpers in enumerate(dict.fromkeys(choices)) if len(helpers) > 1
            ]
    predictions = []
    for first in range(0, len(cases), PREDICTED_AT_ONCE):
        rows, helpers, nearest = zip(*cases[first : first + PREDICTED_AT_ONCE], strict=True)
        targets = neighbours.targets[list(rows)].tolist()
        for target, is_nearest, figures in zip(targets, nearest, neighbours.predict(rows, helpers), strict=True):
            predictions.append(Prediction(target, is_nearest, *figures))
    return predictions


LIMITS = (0.02, 0.995)  # of an MS-SSIM whose logit is taken
SMOOTHING = 0.01


def hardness_of_views(sweep: Sweep, predictions: Sequence[Prediction]) -> FloatArray:  # [F]
    """How far the frames on either side of each frame tell less of it than is usual at such distances, in logits.

    A mean over both sides by the squares of their distances: where frames lie close on one side, and a gap is on the
    other that shows something else behind it, poses are asked for in the gap. It is smoothed over the views around.
    `predictions` are the `one_sided` of the sweep.
    """
    if not predictions:
        return np.zeros(len(sweep))
    distances_mm = np.array([one.measures.distance_mm.mean() for one in predictions])
    quality = np.clip([one.ms_ssim for one in predictions], *LIMITS)
    logits = np.log(quality / (1.0 - quality))
    terms = np.stack([np.ones_like(distances_mm), distances_mm, np.log(distances_mm + NEAR_MM)], axis=1)
    fitted = np.linalg.solve(terms.T @ terms + SMOOTHING * len(terms) * np.diag([0.0, 1.0, 1.0]), terms.T @ logits)
    misses = terms @ fitted - logits
    targets, rows = np.unique([one.target for one in predictions], return_inverse=True)
    shares = np.where([one.is_nearest for one in predictions], np.square(distances_mm), 0.0)
    sums, totals = (np.bincount(rows, values, len(targets)) for values in (shares * misses, shares))
    weights = TrainingViews(sweep.poses[targets], sweep.probe).measure(sweep.poses, sweep.probe).weights  # [F, T]
    return weights @ sums / np.maximum(weights @ totals, 1e-6)


PRIOR_WEIGHTS = (3.6, 1.1, 1.5, 0.3, 0.6)  # about those of ten scenes; one that no view determines stays near its own
PRIOR_STRENGTH = 0.1  # squared error that is added for a weight that is 1 away from its prior
SHIFT_STRENGTH = 0.02  # the same of the shift between a scene's frames and interpolated ones, whose prior is 0
GAIN_QUANTILE = 0.85  # share of the frames, of those that the gain is fitted on, that stay below the limit
LEAST_SHARE = 0.02  # of supported pixels: fewer are taken as this many
REACHES_MM = np.geomspace(0.2, 30.0, 60)  # values of r that are tried
FIT_STEPS = 100


@dataclass(frozen=True, eq=False)
class Examples:
    """Frames with the terms of their poses and the MS-SSIM that they reached."""

    terms: FloatArray  # [C, K, 1 + TERMS]
    ms_ssim: FloatArray  # [C]


def fit_support(
    measures: ViewMeasures,
    shares: FloatArray,  # [C] of supported pixels
    ms_ssim: FloatArray,  # [C]
    black_ms_ssim: float,
) -> Support:
    """The gain, at least 1, that holds for GAIN_QUANTILE of the frames; share and reach of the least squared error."""
    reached = (ms_ssim - black_ms_ssim) / ((1.0 - black_ms_ssim) * np.maximum(shares, LEAST_SHARE))
    fits = []
    for reach_mm in REACHES_MM:
        near = within(measures.distance_mm, reach_mm)
        share = min(1.0, max(LEAST_SHARE, float(near @ shares) / max(float(near @ near), 1e-9)))
        fits.append((float(np.square(share * near - shares).sum()), share, float(reach_mm)))
    _, share, reach_mm = min(fits)
    return Support(max(1.0, float(np.quantile(reached, GAIN_QUANTILE))), share, reach_mm)


def fit_weights(
    rendered: Examples,
    black_ms_ssim: float,
    interpolated: Examples | None = None,
) -> FloatArray:  # [1 + TERMS]
    """The weights with the least squared error of the figure, and little away from PRIOR_WEIGHTS; only w₀ may be < 0.

    Interpolated frames, as many as they may be, count as much as the rendered ones. They reach other scores at the
    same place: a shift of w₀, fitted too, is theirs alone, so that they tell how scores fall and not how high they are.
    Levenberg-Marquardt steps; a weight that would turn negative is held at 0.
    """
    parts = [rendered] if interpolated is None or not len(interpolated.ms_ssim) else [rendered, interpolated]
    counts = [len(part.ms_ssim) for part in parts]
    shifted = np.repeat([0.0, 1.0][: len(parts)], counts)  # [C]
    shares = np.repeat([counts[0] / count for count in counts], counts)  # [C] of each squared error
    terms = np.concatenate([part.terms for part in parts])
    terms = np.concatenate([terms, np.broadcast_to(shifted[:, None, None], (*terms.shape[:2], 1))], axis=2)
    ms_ssim = np.concatenate([part.ms_ssim for part in parts])
    prior = np.array([*PRIOR_WEIGHTS, 0.0])
    strength = np.array([PRIOR_STRENGTH] * len(PRIOR_WEIGHTS) + [SHIFT_STRENGTH])
    bounded = slice(1, 1 + TERMS)
    weights, damping = prior.copy(), 1.0

    def cost(candidate: FloatArray) -> float:
        misses = predicted(candidate, terms, black_ms_ssim) - ms_ssim
        return float(shares @ np.square(misses) + strength @ np.square(candidate - prior))

    for _ in range(FIT_STEPS):
        curve = logistic(terms @ weights)
        slope = (1.0 - black_ms_ssim) * ((curve * (1.0 - curve))[..., None] * terms).mean(axis=1)
        misses = predicted(weights, terms, black_ms_ssim) - ms_ssim
        gradient = slope.T @ (shares * misses) + strength * (weights - prior)
        free = np.ones(len(weights), bool)
        free[bounded] = (weights[bounded] > 0.0) | (gradient[bounded] < 0.0)
        curvature = (slope.T * shares) @ slope + np.diag(strength + damping)
        step = np.zeros_like(weights)
        step[free] = np.linalg.solve(curvature[np.ix_(free, free)], -gradient[free])
        candidate = weights + step
        candidate[bounded] = np.maximum(candidate[bounded], 0.0)
        if cost(candidate) < cost(weights):
            weights, damping = candidate, max(0.3 * damping, 1e-6)
        else:
            damping = min(4.0 * damping, 1e6)
    return weights[:-1]


def one_sided_examples(sweep: Sweep, predictions: Sequence[Prediction], hardness: FloatArray) -> Examples:
    """The `one_sided` predictions of a sweep, with the `hardness` [F] of its frames."""
    if not predictions:
        return Examples(np.zeros((0, POINTS_PER_SIDE**2, 1 + TERMS)), np.zeros(0))
    targets = [one.target for one in predictions]
    names = ("nearest_mm", "distance_mm", "interpolation_mm", "angle_deg")
    distances = {name: np.concatenate([getattr(one.measures, name) for one in predictions]) for name in names}
    weights = TrainingViews(sweep.poses, sweep.probe).measure(sweep.poses[targets], sweep.probe).weights  # [E, F]
    return Examples(
        terms_of(ViewMeasures(**distances, weights=weights), hardness), np.array([one.ms_ssim for one in predictions])
    )


LOOKED_AT = 40_000  # cells, over all frames
FAR_SHARE = 0.05  # of the weight of those cells: weight of places far from all views, where no frame shows the error
ITERATIONS = 300


def fit_uncertainty(scene: GaussianScene, views: TrainingViews, sweep: Sweep, *, backend: str) -> Uncertainty:
    """The variances that make the errors of the scene on the frames of a sweep likeliest.

    `views` are those that the scene was trained from. Far from them no errors are known, and there the variance is
    to be that of the training images.
    """
    edges = np.linspace(0, sweep.height, DEPTHS + 1).round().astype(int)
    by_depth = [sweep.images[:, low:high] / np.float32(255.0) for low, high in pairwise(edges)]
    bands = DepthBands(tuple(float(one.mean()) for one in by_depth), tuple(float(one.var()) for one in by_depth))
    stride = max(1, len(sweep) * CELLS**2 // LOOKED_AT) | 1  # odd, while CELLS is even: cells of every column are taken
    terms, squares = [], []
    for some, frames in rendered_parts(scene, sweep, UNCERTAINTY.planes, backend):
        planes = tuple(frames[name].cpu() for name in UNCERTAINTY.planes)
        distances = view_distances(views, some.poses, some.probe)
        columns = [term.flatten()[::stride] for term in variance_terms(planes, distances, bands)]
        terms.append(torch.stack(columns, dim=1).double().numpy())
        errors = torch.from_numpy(some.images).float().div_(255.0) - planes[0]
        squares.append(in_cells(errors.square()).flatten()[::stride].double().numpy())
    far_terms, far_squares = _far_away(bands)
    weight = FAR_SHARE * sum(map(len, squares)) / len(far_squares)
    variances = likeliest_variances(
        np.concatenate([*terms, far_terms]),
        np.concatenate([*squares, far_squares]),
        np.concatenate([*(np.ones(len(some)) for some in squares), np.full(len(far_squares), weight)]),
    )
    return Uncertainty(tuple(variances.tolist()), bands)


def likeliest_variances(terms: FloatArray, squares: FloatArray, weights: FloatArray) -> FloatArray:  # [M, K], [M], [M]
    """c ≥ 0 for which terms @ c fits squared errors best, their spread taken as growing with them (Poisson's deviance).

    Multiplicative updates (Richardson 1972, Lucy 1974), which keep every cₖ positive and always gain.
    """
    variances = np.full(terms.shape[1], 0.05)
    sums = np.maximum(terms.T @ weights, 1e-12)
    for _ in range(ITERATIONS):
        expected = np.maximum(terms @ variances, 1e-9)
        variances = variances * (terms.T @ (weights * squares / expected)) / sums
    return variances


def _far_away(bands: DepthBands) -> tuple[FloatArray, FloatArray]:  # [DEPTHS, TERMS], [DEPTHS]
    """The terms of a black frame far from every view, and its expected squared error, in the middle of each band."""
    dark, lit = torch.zeros(1, DEPTHS, 1), torch.ones(1, DEPTHS, 1)
    far = np.full((1, DEVIATION_POINTS, DEVIATION_POINTS), FAR_MM)
    columns = [term.flatten() for term in variance_terms((dark, dark, lit), (far, far), bands)]
    squares = np.array(bands.spread) + np.square(bands.level)
    return torch.stack(columns, dim=1).double().numpy(), squares


SHORTER, ENOUGH_STEPS = 0.25, 375  # share of the steps, and the number that is not cut: longer tells the same
MEASURED_FRAMES = 96  # of those held out; of those trained from a third as many
BLACK_FRAMES = 32

TrainShorter: TypeAlias = Callable[[Dataset], GaussianScene | None]


def shorter(config: TrainingConfig, share: float) -> TrainingConfig:
    """The configuration of a training on `share` of the frames, with nothing left open: a quarter of the steps, or
    ENOUGH_STEPS."""
    assert config.steps is not None
    assert config.max_gaussians is not None
    assert config.initial_gaussians is not None
    return replace(
        config,
        steps=min(config.steps, max(math.ceil(SHORTER * config.steps), ENOUGH_STEPS)),
        max_gaussians=math.ceil(share * config.max_gaussians),
        initial_gaussians=math.ceil(share * config.initial_gaussians),
    )


def steps_of_fit(config: TrainingConfig, sweep: Sweep) -> float:
    """The steps of a run on all frames of the sweep that take about as long as the shorter training; 0 without one."""
    held_out = len(held_out_frames(sweep))
    if held_out < LEAST_HELD_OUT:
        return 0.0
    share = 1.0 - held_out / len(sweep)
    steps = shorter(config, share).steps
    assert steps is not None
    return share * steps


def fit_confidence(dataset: Dataset, train_shorter: TrainShorter, *, backend: str) -> ConfidenceModel | None:
    """Holds frames of `dataset.train` out, trains from the others and fits the model to the scores of those held out.

    How fast scores fall farther away is told by frames that are extrapolated from others without learning, too.

    None where there are too few frames, or where `train_shorter` returns none.
    """
    sweep = dataset.train
    held_out = held_out_frames(sweep)
    if len(held_out) < LEAST_HELD_OUT:
        return None
    kept = np.setdiff1d(np.arange(len(sweep)), held_out)
    part = Dataset(dataset.name, train=sweep.select(kept), val=sweep.select([]))
    scene = train_shorter(part)
    if scene is None:
        return None
    seen = kept[spread_places(len(kept), MEASURED_FRAMES // 3)]
    unseen = held_out[spread_places(len(held_out), MEASURED_FRAMES)]
    both = sweep.select(np.concatenate([unseen, seen]))
    ms_ssim, shares = _measured(scene, both, backend)
    views = TrainingViews(part.train.poses, sweep.probe)
    measures = views.measure(both.poses, sweep.probe)
    terms = terms_of(measures, hardness_of_views(part.train, one_sided(part.train)))
    some = sweep.select(spread_places(len(sweep), BLACK_FRAMES))
    black = evaluate_frames(np.zeros(some.images.shape, np.float32), some).mean.ms_ssim  # that black frames reach
    predictions = one_sided(sweep)
    hardness = hardness_of_views(sweep, predictions)
    weights = fit_weights(Examples(terms, ms_ssim), black, one_sided_examples(sweep, predictions, hardness))
    misses = np.abs(predicted(weights, terms, black) - ms_ssim)[: len(unseen)]
    return ConfidenceModel(
        weights=tuple(weights.tolist()),
        black_ms_ssim=black,
        hardness=tuple(hardness.tolist()),
        fitted_on=len(unseen),
        error=float(misses.mean()),
        support=fit_support(measures, shares, ms_ssim, black),
        fitted_to_mm=float(measures.distance_mm.max()),
        uncertainty=fit_uncertainty(scene, views, both, backend=backend),
    )


def _measured(scene: GaussianScene, sweep: Sweep, backend: str) -> tuple[FloatArray, FloatArray]:  # [F], [F]
    ms_ssim = [frame.ms_ssim for frame in evaluate(scene, sweep, backend=backend).frames]
    coverage = render_sweep(scene, sweep, output="coverage", backend=backend)
    return np.array(ms_ssim), supported(coverage).mean(axis=(1, 2))
