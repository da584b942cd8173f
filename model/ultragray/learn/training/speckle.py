"""The fit of a scene's speckle: rendering and speckle together get the statistics of the training frames.

Rendered frames lack texture, the more so between training frames, where most of what is asked for lies: so statistics
are those of frames rendered halfway between training frames, beside these. What is compared are windows of calm
tissue: their variance by grey level, their covariance along depth and across lines by band of depth, their skewness.
Widths, strength and looks are corrected by what is still missing, a few times. Then pairs of training frames tell how
windows at the same place in space decorrelate with the distance along elevation, and with the angle between frames.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from ultragray.geometry.probe import FloatArray
from ultragray.geometry.rotations import blended
from ultragray.learn.evaluation.speckle import (
    BLACK,
    SATURATED,
    STRAY_SHARE,
    WINDOW_PIXELS,
    FrameArray,
    WindowPairs,
    correlation,
    tiles_of,
    unrest,
)
from ultragray.learn.sweep import IntArray, Sweep, spread_places
from ultragray.rendering.frames import render
from ultragray.rendering.speckle import Compression, kernel_speckle, sweep_axes
from ultragray.scene.gaussians import GaussianScene
from ultragray.scene.speckle import BANDS, LARGEST_MM, LEVELS, SMALLEST_MM, SpeckleModel

SEED = 40
MOST_FRAMES = 24
CALM_SHARE = 0.5  # of the windows
MAX_LAG = 6  # pixels
CORRECTIONS = 8
LEAST_WINDOWS = 40  # of a band or a level
SMALLEST_PIXELS, LARGEST_PIXELS = 0.35, 6.0  # of a width
CELLS_PER_SIGMA = 2.0  # shorter ones would come and go between samples as the probe moves
_HALF_DEVIATION = 0.58  # of a normal variable of deviation 1 whose negative values are 0
_SMOOTHING = 0.5 * np.eye(LEVELS) + 0.25 * (np.eye(LEVELS, k=1) + np.eye(LEVELS, k=-1))
SKEWNESS = (-1.13, 1.2)  # that looks and floor can give


def fit_speckle(scene: GaussianScene, sweep: Sweep, *, backend: str) -> SpeckleModel | None:
    """The speckle of the frames of `sweep`, from which the scene was trained; None where they show none.

    Poses are in the tissue at rest, and so are those of the scene.

    In seconds: MOST_FRAMES of them are looked at, and as many pairs.
    """
    if min(sweep.height, sweep.width) < 2 * WINDOW_PIXELS:
        return None
    chosen = spread_places(len(sweep), MOST_FRAMES)
    rendered = _rendered(scene, sweep, _halfway(sweep, chosen), backend)
    fit = _Fit(sweep, sweep_axes(sweep.poses), _halfway(sweep, chosen), rendered)
    truth = fit.statistics(sweep.images[chosen].astype(np.float32) / 255.0)
    if truth is None:
        return None
    model = fit.looks_like(truth, fit.start())
    if not any(model.strength):
        return None
    return fit_motion(scene, sweep, model, chosen, backend)


def _rendered(scene: GaussianScene, sweep: Sweep, poses: FloatArray, backend: str) -> FrameArray:  # [C, H, W]
    with torch.no_grad():
        frames = [
            render(
                scene, sweep.probe, pose, height=sweep.height, width=sweep.width, outputs=("bmode",), backend=backend
            )["bmode"]
            for pose in poses
        ]
    return np.asarray(torch.cat(frames).float().cpu().numpy())


def _halfway(sweep: Sweep, chosen: IntArray) -> FloatArray:  # [C, 4, 4] mm
    """The poses in the middle between frames and those nearest to them."""
    middles = sweep.corners_mm().mean(axis=1)
    away = np.linalg.norm(middles[chosen, None] - middles, axis=-1)
    away[np.arange(len(chosen)), chosen] = np.inf
    nearest = away.argmin(axis=1)
    poses = sweep.poses[chosen].copy()
    poses[:, :3, 3] = 0.5 * (sweep.poses[chosen, :3, 3] + sweep.poses[nearest, :3, 3])
    halves = np.full(len(chosen), 0.5)
    poses[:, :3, :3] = blended(sweep.poses[chosen, :3, :3], sweep.poses[nearest, :3, :3], halves)
    return poses


@dataclass(frozen=True, eq=False)
class _Statistics:
    """Of calm windows; covariances are means over the windows of a band."""

    axial: FloatArray  # [BANDS, MAX_LAG + 1]
    lateral: FloatArray  # [BANDS, MAX_LAG + 1]
    deviation: FloatArray  # [LEVELS] mean of the windows' own: some windows with structure do not decide it
    counts: FloatArray  # [LEVELS] of windows
    skewness: float  # mean of the windows' own
    black: float | None  # deviation in black windows, the median; None where there are few


class _Fit:
    """Frames rendered at some poses, and how windows of them look with the speckle of a model."""

    def __init__(self, sweep: Sweep, axes: FloatArray, poses: FloatArray, rendered: FrameArray) -> None:
        self._sweep, self._axes, self._poses, self._rendered = sweep, axes, poses, rendered
        self._calm: tuple[IntArray, ...] = ()
        rows = sweep.height // WINDOW_PIXELS
        columns = sweep.width // WINDOW_PIXELS
        self._bands = np.repeat(np.arange(rows) * BANDS // rows, columns)  # [T]
        probe = sweep.probe
        middles = probe.near_mm + (np.arange(BANDS) + 0.5) / BANDS * probe.scan_line_length_mm
        breadths = np.array([probe.lines.breadth_mm(float(depth)) for depth in middles])
        axial = np.full(BANDS, probe.scan_line_length_mm / sweep.height)
        self._pixels_mm = {"axial": _limited(axial), "lateral": _limited(breadths / sweep.width)}

    def start(self) -> SpeckleModel:
        """Speckle of about a pixel."""
        return with_cells(
            SpeckleModel(
                seed=SEED,
                axial_mm=tuple(self._pixels_mm["axial"].tolist()),
                lateral_mm=tuple(self._pixels_mm["lateral"].tolist()),
                elevation_mm=tuple(self._pixels_mm["lateral"].tolist()),
                cell_mm=(1.0, 1.0, 1.0),
                strength=(0.05,) * LEVELS,
            ),
            self._sweep,
        )

    def statistics(self, frames: FrameArray) -> _Statistics | None:  # [C, H, W]
        """None where there are too few windows. Those of the first call, which are calm, are kept for the others."""
        tiles = np.stack([tiles_of(frame) for frame in frames])  # [C, T, n, n]
        if not self._calm:
            stray = ((tiles < BLACK) | (tiles > SATURATED)).mean(axis=(2, 3)) > STRAY_SHARE
            restless = np.where(stray, np.inf, np.stack([unrest(some) for some in tiles]))
            count = int(CALM_SHARE * np.isfinite(restless).sum())
            if count < LEAST_WINDOWS:
                return None
            limit = np.partition(restless.ravel(), count - 1)[count - 1]
            self._calm = np.nonzero(restless <= limit)
        dark = tiles[tiles.mean(axis=(2, 3)) < BLACK]
        tiles = tiles[self._calm].astype(np.float64)
        bands = self._bands[self._calm[1]]
        level = tiles.mean(axis=(1, 2))
        off = tiles - level[:, None, None]
        deviation = off.std(axis=(1, 2))
        axial, lateral = (
            np.stack(
                [(one[:, lag:] * one[:, : WINDOW_PIXELS - lag]).mean(axis=(1, 2)) for lag in range(MAX_LAG + 1)], axis=1
            )
            for one in (off, off.swapaxes(1, 2))
        )  # [N, MAX_LAG + 1]
        shares = np.maximum(1.0 - np.abs(level[:, None] * (LEVELS - 1) - np.arange(LEVELS)), 0.0)  # [N, LEVELS]
        counts = shares.sum(axis=0)
        by_band = [np.stack([some[bands == band].sum(axis=0) for band in range(BANDS)]) for some in (axial, lateral)]
        windows = np.maximum([(bands == band).sum() for band in range(BANDS)], 1)[:, None]
        return _Statistics(
            by_band[0] / windows,
            by_band[1] / windows,
            shares.T @ deviation / np.maximum(counts, 1e-9),
            counts,
            float(((off**3).mean(axis=(1, 2)) / np.maximum(deviation, 1e-4) ** 3).mean()),
            float(np.median(dark.std(axis=(1, 2)))) if len(dark) > LEAST_WINDOWS else None,
        )

    def with_speckle(self, model: SpeckleModel) -> FrameArray:
        bmode = torch.from_numpy(self._rendered)
        return kernel_speckle(model, self._axes, self._sweep.probe, self._poses, bmode).numpy()

    def looks_like(self, truth: _Statistics, model: SpeckleModel) -> SpeckleModel:
        """The model with which windows have the statistics of true ones."""
        plain = self.statistics(self._rendered)
        assert plain is not None
        skewness = 0.0
        for _ in range(CORRECTIONS):
            current = self.statistics(self.with_speckle(model))
            assert current is not None
            widths: dict[str, Any] = {}
            for name, pixels_mm in self._pixels_mm.items():
                own, wanted, without = (getattr(one, name) for one in (current, truth, plain))
                ratios = _width(wanted - without) / _width(own - without)
                ratios = np.clip(np.where(np.isfinite(ratios), ratios, 1.0), 0.6, 1.6)
                pixels = np.clip(getattr(model, f"{name}_mm") * ratios / pixels_mm, SMALLEST_PIXELS, LARGEST_PIXELS)
                widths[f"{name}_mm"] = tuple(_limited(pixels * pixels_mm).tolist())
            strength = _strength(model, truth, plain, current)
            skewness = float(np.clip(skewness + truth.skewness - current.skewness, *SKEWNESS))
            looks, floor = looks_and_floor(skewness)
            model = with_cells(
                replace(
                    model,
                    **widths,
                    strength=tuple(strength.tolist()),
                    looks=looks,
                    floor=floor,
                ),
                self._sweep,
            )
        return model


def _limited(widths_mm: FloatArray) -> FloatArray:
    """What a model may have."""
    return np.clip(widths_mm, SMALLEST_MM, LARGEST_MM)


def _width(covariance: FloatArray) -> FloatArray:  # [BANDS, MAX_LAG + 1] -> [BANDS] pixels; NaN: not to be told
    """Where the correlation is a half, or where it would be if it were a Gaussian's."""
    widths = np.full(len(covariance), np.nan)
    for band, own in enumerate(covariance):
        if own[0] <= 1e-7:
            continue
        correlation = own / own[0]
        below = np.flatnonzero(correlation < 0.5)
        if not len(below):
            widths[band] = MAX_LAG
        elif below[0] == 1:
            widths[band] = np.sqrt(np.log(2.0) / -np.log(np.clip(correlation[1], 1e-3, 0.5)))
        else:
            before = below[0] - 1
            widths[band] = before + (correlation[before] - 0.5) / (correlation[before] - correlation[below[0]])
    return widths


def _strength(model: SpeckleModel, truth: _Statistics, plain: _Statistics, current: _Statistics) -> FloatArray:
    """What is missing at each grey level; levels with few windows take that of their neighbours."""
    missing, present = (np.square(one.deviation) - np.square(plain.deviation) for one in (truth, current))
    known = (truth.counts > LEAST_WINDOWS / 4) & (plain.counts > LEAST_WINDOWS / 4)
    ratios = np.sqrt(np.clip(missing / np.maximum(present, 1e-9), 0.0, 4.0))
    now = np.array(model.strength) * ratios
    weights = np.where(known, truth.counts, 0.0)
    beside = _SMOOTHING @ weights  # windows hold grey levels beside their own: alone, levels would swing
    smooth = _SMOOTHING @ (weights * now) / np.maximum(beside, 1e-9)
    levels = np.flatnonzero(known)
    strengths = np.interp(np.arange(LEVELS), levels, smooth[levels]) if len(levels) else np.zeros(LEVELS)
    if truth.black is not None:
        strengths[0] = min(strengths[0], truth.black / _HALF_DEVIATION)
    return np.clip(strengths, 0.0, 0.5)


def looks_and_floor(skewness: float) -> tuple[float, float]:
    """Looks and floor of the log of a power that has this skewness."""
    if skewness <= Compression.of(2.0, 0.0).skewness:
        looks = np.linspace(1.0, 2.0, 101)
        return float(looks[np.argmin([abs(Compression.of(float(one), 0.0).skewness - skewness) for one in looks])]), 0.0
    floors = np.concatenate([[0.0], np.geomspace(1e-3, 1e2, 120)])
    return 2.0, float(floors[np.argmin([abs(Compression.of(2.0, float(one)).skewness - skewness) for one in floors])])


def with_cells(model: SpeckleModel, sweep: Sweep) -> SpeckleModel:
    """Cells by the narrowest point-spread function, and no shorter than a pixel."""
    axial, lateral = (min(widths) for widths in (model.axial_mm, model.lateral_mm))
    pixel = sweep.pixel_mm
    cells = (
        max(CELLS_PER_SIGMA * lateral, min(pixel[1], 3.0 * lateral)),
        max(model.elevation_mm) / 0.75,
        max(CELLS_PER_SIGMA * axial, min(pixel[0], 3.0 * axial)),
    )
    return replace(model, cell_mm=tuple(_limited(np.array(cells)).tolist()))


# How speckle changes as the probe moves: the width of the slice, and the carrier.

ANCHORS, PARTNERS = 12, 10  # frames that are compared, and those with which each is
ELEVATION_MM = np.array([0.0, 0.1, 0.2, 0.35, 0.6, 1.0, 1.5, 2.5, 4.0])  # edges of the distances that are told apart
ANGLE_DEG = np.array([0.0, 1.0, 2.5, 5.0, 10.0, 20.0])  # and of the angles
SLICES = np.geomspace(0.3, 10.0, 13)  # widths that are tried, by the lateral one
WAVENUMBERS = (2.0, 4.0, 8.0, 14.0, 24.0, 40.0)  # per mm
CLEARLY = 0.9  # of the error that is left: a carrier that leaves more is none
LEAST_PAIRS = 60  # of windows


def fit_motion(scene: GaussianScene, sweep: Sweep, model: SpeckleModel, chosen: IntArray, backend: str) -> SpeckleModel:
    """The model with the slice's width and the carrier by which windows decorrelate as those of the frames do."""
    pairs = frame_pairs(sweep)
    if not len(pairs):  # frames too far apart to share any speckle
        return model
    frames = np.unique(pairs)
    part = sweep.select(frames)
    places = np.searchsorted(frames, pairs)
    images = part.images.astype(np.float32) / 255.0
    windows = WindowPairs.between(images, part.poses, part.probe, places)
    if len(windows.depth) < LEAST_PAIRS:
        return model
    rendered = torch.from_numpy(_rendered(scene, part, part.poses, backend))
    axes, wanted = sweep_axes(sweep.poses), windows.moments(images)

    def moments(one: SpeckleModel) -> FloatArray:
        return windows.moments(kernel_speckle(one, axes, part.probe, part.poses, rendered).numpy())

    bands = np.minimum((windows.depth * BANDS).astype(int), BANDS - 1)
    upright = windows.angle_deg < ANGLE_DEG[1]
    widths = _limited(SLICES * float(np.mean(model.lateral_mm)))
    errors = np.full((len(widths), BANDS), np.inf)
    for place, width in enumerate(widths):
        own = moments(with_cells(replace(model, elevation_mm=(float(width),) * BANDS), sweep))
        for band in range(BANDS):
            some = (bands == band) & upright
            if some.sum() >= LEAST_PAIRS:
                errors[place, band] = _error(windows.elevation_mm[some], ELEVATION_MM, own[some], wanted[some])
    known = np.isfinite(errors).all(axis=0)
    if not known.any():
        return model
    counts = np.array([((bands == band) & upright).sum() for band in range(BANDS)])[known]
    common = int((errors[:, known] @ counts).argmin())
    near = slice(max(common - 1, 0), common + 2)  # a band alone is not trusted with more
    best = widths[near][errors[near, known].argmin(axis=0)]
    slices = np.interp(np.arange(BANDS), np.flatnonzero(known), best)
    model = with_cells(replace(model, elevation_mm=tuple(slices.tolist())), sweep)
    tilted = ~upright & (windows.elevation_mm < np.array(model.elevation_mm)[bands])
    if tilted.sum() < LEAST_PAIRS:
        return model
    models = [replace(model, wavenumber_per_mm=one) for one in (0.0, *WAVENUMBERS)]
    losses = [_error(windows.angle_deg[tilted], ANGLE_DEG, moments(one)[tilted], wanted[tilted]) for one in models]
    return models[int(np.argmin(losses))] if min(losses) < CLEARLY * losses[0] else model


def frame_pairs(sweep: Sweep) -> IntArray:  # [P, 2]
    """Frames all over the sweep, each with those beside it: half the nearest ones, half others at most 6 mm away."""
    middles = sweep.corners_mm().mean(axis=1)
    pairs = []
    for anchor in spread_places(len(sweep), ANCHORS):
        away = np.linalg.norm(middles - middles[anchor], axis=1)
        others = np.argsort(away, kind="stable")
        others = others[(others != anchor) & (away[others] < 6.0)]
        nearest, rest = others[: PARTNERS // 2], others[PARTNERS // 2 :]
        for other in (*nearest, *rest[spread_places(len(rest), PARTNERS // 2)]):
            pairs.append((anchor, other))
    return np.array(pairs, np.int64).reshape(-1, 2)


def _error(values: FloatArray, edges: FloatArray, own: FloatArray, wanted: FloatArray) -> float:
    """Mean squared difference of correlations by bins of a value, weighted by the number of windows [N, 3]."""
    bins = np.digitize(values, edges)
    total = 0.0
    for one in np.unique(bins):
        some = bins == one
        total += some.sum() * (correlation(own[some]) - correlation(wanted[some])) ** 2
    return total / len(values)
