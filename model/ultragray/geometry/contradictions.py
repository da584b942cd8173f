"""Samples of a registration that contradict each other: which one is worst, and which mistake would explain it.

Each likely mistake is undone, and the fit tried again: the one that leaves least is the likely cause.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from itertools import combinations
from typing import Any

import numpy as np

from ultragray.errors import UltragrayError
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import FloatArray
from ultragray.geometry.registration import (
    LEVER_MM,
    PointFit,
    PoseFit,
    register_points,
    register_poses,
    register_poses_and_mounting,
)

LARGEST_MM, LARGEST_DEG = 5.0, 3.0  # residuals of samples that agree, as hands and trackers measure
SMALLEST_MM, SMALLEST_DEG = 0.5, 0.5  # below which nothing is doubted
SMALLEST_SPAN_MM = 2.0  # of the samples: a metre of a robot's way, taken as millimetres, is less
CURED = 0.2  # of the residuals: a mistake whose undoing leaves no more is the likely cause
MOST_EXCHANGED = 12  # samples, the worst, among which two exchanged ones are looked for
LEAST_TO_LEAVE_ONE_OUT = 5
LEAST_TO_DRIFT, DRIFT_FITS = 8, 12
SMALLEST_DRIFT_MM, CLEAR_DRIFT = 2.0, 5.0  # the second in standard errors of the slope
FLOOR_MM = 1e-3  # residuals below it are alike
UNITS = {1000.0: "metres", 10.0: "centimetres"}

_Series = dict[str, FloatArray]
_Score = tuple[float, float]  # what is left, and how far off the flange the probe would be: of two as good, the nearer


def pose_contradiction(
    fit: PoseFit, flange_to_base: Any, probe_to_scene: Any, *, is_mounting_given: bool
) -> str | None:
    """The worst sample and the likely cause, in words; None where the poses agree."""
    series = {"flange": check_poses(flange_to_base), "probe": check_poses(probe_to_scene)}
    if is_mounting_given:
        series["probe_to_flange"] = fit.probe_to_flange[None]

    def fitted(series: _Series) -> PoseFit:
        poses = series["flange"], series["probe"]
        return (
            register_poses(*poses, series["probe_to_flange"][0])
            if is_mounting_given
            else register_poses_and_mounting(*poses)
        )

    def score(series: _Series) -> _Score:
        new_fit = fitted(series)
        mounted_mm = float(np.linalg.norm(new_fit.probe_to_flange[:3, 3]))
        return _root_mean_square(new_fit.residuals_mm, new_fit.residuals_deg), mounted_mm

    drift = _drift(series, fitted) if len(series["probe"]) >= LEAST_TO_DRIFT else None
    return _explained(series, fit.residuals_mm, fit.residuals_deg, score, drift)


def point_contradiction(fit: PointFit, in_base: Any, in_scene: Any) -> str | None:
    """As `pose_contradiction`, of points [N, 3]."""
    series = {"base": np.asarray(in_base, np.float64), "scene": np.asarray(in_scene, np.float64)}
    nothing = np.zeros_like(fit.residuals_mm)
    return _explained(
        series, fit.residuals_mm, nothing, lambda series: (register_points(series["base"], series["scene"]).rms_mm, 0.0)
    )


def _root_mean_square(mm: FloatArray, deg: FloatArray) -> float:
    return float(np.sqrt(np.mean(mm**2 + (LEVER_MM * np.radians(deg)) ** 2)))


def _drift(series: _Series, fitted: Callable[[_Series], PoseFit]) -> tuple[str, float] | None:
    """A probe that is measured further off with every sample, evenly, in words, and the residuals without it in mm.

    The slope of the residuals over the samples is taken off the positions, and the poses are fitted again, until no
    slope is left: a fit takes a part of the drift for its own. None where the slope is not far beyond its own standard
    error.
    """
    since, drift_mm, off = np.linspace(-0.5, 0.5, len(series["probe"])), np.zeros(3), np.zeros((0, 3))
    for _ in range(DRIFT_FITS):
        probes = series["probe"].copy()
        probes[:, :3, 3] -= since[:, None] * drift_mm
        try:
            fit = fitted({**series, "probe": probes})
        except UltragrayError:
            return None
        off = probes[:, :3, 3] - (fit.base_to_scene @ series["flange"] @ fit.probe_to_flange)[:, :3, 3]
        drift_mm = drift_mm + since @ off / (since @ since)
    far_mm, residual_mm = float(np.linalg.norm(drift_mm)), float(np.sqrt(np.square(off).sum(axis=1).mean()))
    if far_mm < max(SMALLEST_DRIFT_MM, CLEAR_DRIFT * residual_mm / float(np.sqrt(since @ since))):
        return None
    return f"the probe slipped or a tracker drifts, by {far_mm:.2g} mm from the first sample to the last", residual_mm


def _explained(
    series: _Series,
    mm: FloatArray,
    deg: FloatArray,
    score: Callable[[_Series], _Score],
    drift: tuple[str, float] | None = None,
) -> str | None:
    spans_mm = [float(np.ptp(_positions(samples), axis=0).max()) for samples in list(series.values())[:2]]
    if max(spans_mm) < SMALLEST_SPAN_MM:
        return f"all samples lie within {max(spans_mm):.2g} mm: are their positions in metres?"
    if mm.max() < SMALLEST_MM and deg.max() < SMALLEST_DEG:
        return None
    weights = mm**2 + (LEVER_MM * np.radians(deg)) ** 2
    best, cause = (CURED * _root_mean_square(mm, deg), 0.0), ""
    for text, changes in _mistakes(series, np.argsort(-weights)):
        try:
            residual_mm, mounted_mm = score({**series, **changes})
        except UltragrayError:  # what is left cannot be fitted
            continue
        if (max(FLOOR_MM, residual_mm), mounted_mm) < best:
            best, cause = (max(FLOOR_MM, residual_mm), mounted_mm), text
    if not cause and drift is not None:
        cause, best = drift[0], (drift[1], 0.0)
    if not cause and mm.max() <= LARGEST_MM and deg.max() <= LARGEST_DEG:
        return None
    worst = int(weights.argmax())
    angle = f" and {deg[worst]:.2g}°" if deg.any() else ""
    likely = f"likely {cause} (without it {best[0]:.2g} mm are left)" if cause else "no single mistake explains it"
    return (
        f"the samples contradict each other: sample {worst}, the worst (counted from 0), is {mm[worst]:.3g} mm{angle} "
        f"off; {likely}"
    )


def _mistakes(series: _Series, worst_first: np.ndarray) -> Iterator[tuple[str, Mapping[str, FloatArray]]]:
    """Each likely mistake of single samples, of units and of directions."""
    (one_name, one), (other_name, other), *mounting = series.items()
    both = (one_name, other_name)
    for names in (*((name,) for name in series), both):
        what = " and ".join(names)
        for factor, unit in UNITS.items():
            yield f"the positions of {what} are in {unit}", {name: _scaled(series[name], factor) for name in names}
        if one.ndim == 3 and (mounting or names != both):  # with a mounting to be found, both agree all the same
            yield f"the poses of {what} are inverted", {name: _inverted(series[name]) for name in names}
    if len(one) > LEAST_TO_LEAVE_ONE_OUT:
        yield f"{one_name} is one sample late", {one_name: one[1:], other_name: other[:-1]}
        yield f"{one_name} is one sample early", {one_name: one[:-1], other_name: other[1:]}
    for first, second in combinations(sorted(worst_first[:MOST_EXCHANGED]), 2):
        order = np.arange(len(one))
        order[[first, second]] = second, first
        yield f"samples {first} and {second} are exchanged", {other_name: other[order]}
    for place in worst_first if len(one) >= LEAST_TO_LEAVE_ONE_OUT else ():
        kept = np.arange(len(one)) != place
        stale = [
            f", {name} is that of sample {near}: a stale one"
            for name, samples in ((one_name, one), (other_name, other))
            for near in (place - 1, place + 1)
            if 0 <= near < len(one) and np.allclose(samples[near], samples[place], atol=1e-6)
        ]
        yield f"sample {place} alone is wrong{''.join(stale[:1])}", {one_name: one[kept], other_name: other[kept]}


def _inverted(poses: FloatArray) -> FloatArray:  # [N, 4, 4]
    return np.asarray(np.linalg.inv(poses), np.float64)


def _scaled(samples: FloatArray, factor: float) -> FloatArray:  # [N, 4, 4] or [N, 3]
    scaled = samples.copy()
    _positions(scaled)[:] *= factor
    return scaled


def _positions(samples: FloatArray) -> FloatArray:  # [N, 3], a view
    return samples[:, :3, 3] if samples.ndim == 3 else samples
