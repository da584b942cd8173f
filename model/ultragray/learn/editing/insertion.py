"""Bodies that are put into a scene: lesions, vessels, calcifications.

The surface of the body clips what the scene has there (`parts.clipped`), and the inside is filled anew. Grey values are
logarithms: a level of x dB over the tissue around is x / dynamic range more. The model's transmittance multiplies grey
values, where physics subtracts decibels; so what is behind the body loses, of a grey level g as around it, the share
that the decibels of the way there and back are of g: exp(−dB / (dynamic range · g)) is left.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from ultragray.errors import InvalidArgument
from ultragray.geometry.probe import PLANE, FloatArray, LinearProbe
from ultragray.learn.editing.parts import (
    Distance,
    Surface,
    as_sigmoid,
    clipped,
    harmonics_of,
    joined,
    means_mm,
    moved_gaussians,
    normals_of,
    part,
    rebuilt,
    split,
    stacked,
    with_echo,
)
from ultragray.learn.labelling import undirected_echo, with_labels
from ultragray.rendering.frames import render
from ultragray.rendering.volume_fields import sample_volume
from ultragray.rendering.volumes import VolumeGrid
from ultragray.scene.confidence import SUPPORT_COVERAGE
from ultragray.scene.edits import InsertEdit, LesionsEdit
from ultragray.scene.gaussians import GaussianScene
from ultragray.scene.shapes import EllipsoidShape, Shape
from ultragray.scene.tissues import SOFT_TISSUE_DB, TISSUES

FINEST_MM, COARSEST_MM = 0.15, 0.35  # deviations of the Gaussians at the surface of a body
_SPACING = 1.2  # of Gaussians, in their deviations: nine lie over each point
_LARGEST = 4  # times those at the surface: deviations in the depth of a body
_FLATNESS_MM = 0.15  # by which the surface may bend away from a plane within a Gaussian that it clips
_DARK, _LEVEL, _ROUGHNESS = 0.1, 0.3, 0.1  # least level that attenuation is reckoned from; both where nothing is near
_NEAR_MM, _BESIDE_MM = 2.0, 1.75  # at least as far counts as around; so far coverage is kept
_SHARP, _SOFT = 2.5, 1.2  # of the body at its surface, and of what is around: the body outweighs it there
_WALL = "tendon"
_GRAIN = 3.0  # deviations of intensities over that of their mean: nine Gaussians lie over each point
_EVEN_MM = 1.0  # side of the cubes over which texture evens out
_TRIAL, _LINES = 0.05, 64  # 1 − τ, scan lines and samples by which attenuation is measured
_SAMPLES = 40  # on the longer side of the box in which echo is measured
_FIRST_RESIZED, _MOST_RESIZED, _STEPS = -0.05, 0.3, 2  # by which halves are fitted; of the logarithm of their lengths
_TRIES = 200
_LEAST_NEAR = 20  # Gaussians about a place where something may be inserted
_CALCIFICATION = 1.0 / 3.0  # of the radii of other lesions


def insert(scene: GaussianScene, edit: InsertEdit) -> GaussianScene:
    """The scene with a body in it. Raises InvalidArgument, also where no Gaussian of the scene is near."""
    low, high = edit.shape.bounds_mm()
    distance, wall = edit.shape.distance_mm, edit.wall_mm
    if wall > 0.0:
        outer = replace(edit, tissue=_WALL, label=f"{edit.label_name} wall", echo_db=None, attenuation=None)
        around = (low - wall, high + wall)
        scene = _inserted(scene, outer, lambda points: distance(points) - wall, around, finest=wall / 2.0)
    return _inserted(scene, edit, distance, (low, high))


def _inserted(
    scene: GaussianScene,
    edit: InsertEdit,
    distance: Distance,
    bounds: tuple[FloatArray, FloatArray],
    finest: float = math.inf,
) -> GaussianScene:
    scene = as_sigmoid(scene)
    recorded = {name for label, name in scene.info.label_names.items() if label not in scene.info.made_labels}
    if edit.label_name in recorded:
        raise InvalidArgument(
            f"label must be new, or that of what was inserted before: {edit.label_name!r} was recorded", field="label"
        )
    radius = 0.5 * float((bounds[1] - bounds[0]).min())
    away_mm = float(distance(means_mm(scene)).min())
    if away_mm > max(_NEAR_MM, radius):
        low, high = ([round(one) for one in corner] for corner in (scene.info.bounds_min_mm, scene.info.bounds_max_mm))
        raise InvalidArgument(
            f"shape must lie in the scene, from {low} to {high} mm, it is {away_mm:.0f} mm from the nearest Gaussian",
            field="shape",
        )
    around = _Around(distance, bounds, max(_NEAR_MM, radius))
    level, roughness = around.echo(scene)
    outside = _without(scene, radius, around)
    body = _copied(scene, edit, distance, bounds) if edit.texture_from_mm is not None else None
    if body is None:
        sigma = min(max(radius / 6.0, FINEST_MM), COARSEST_MM, finest)
        body = _filled(scene, distance, bounds, max(sigma, 0.1), edit.seed)
        echo = np.random.default_rng(edit.seed).normal(0.0, _GRAIN * roughness, len(body.means))
    else:
        echo = undirected_echo(body) - undirected_echo(body).mean()
    known = TISSUES[edit.tissue]
    echo_db = known.echo_db if edit.echo_db is None else edit.echo_db
    target = max(0.0, level + echo_db / edit.dynamic_range_db)
    spread = min(1.0, target / max(level, _DARK))  # what is dark has little texture
    levels = (target + spread * np.asarray(echo)).clip(min=0.0)
    if edit.texture_from_mm is None:
        levels *= target / np.maximum(_local_mean(body, levels), 1e-6)
    body = with_echo(body, torch.from_numpy(levels).to(body.means))
    attenuation = known.attenuation if edit.attenuation is None else edit.attenuation
    lost_db = 2.0 * edit.frequency_mhz * max(0.0, attenuation - SOFT_TISSUE_DB)  # dB/cm, there and back
    body = _attenuating(body, lost_db / (edit.dynamic_range_db * max(level, _DARK)), distance, bounds)
    count = len(body.means)
    body = with_labels(body, np.ones(count, np.uint8), {1: edit.label_name}, unrecorded=np.ones(count, bool))
    if outside is None:
        provenance = {**scene.info.provenance, **body.info.provenance}
        return rebuilt(scene, body.splats, body.labels, label_names=body.info.label_names, provenance=provenance)
    return joined(outside, body)


class _Around:
    """The surface of a body, and places beside it, outside."""

    def __init__(self, distance: Distance, bounds: tuple[FloatArray, FloatArray], near_mm: float):
        low, high = bounds[0] - near_mm, bounds[1] + near_mm
        spacing_mm = max(0.5, float((high - low).max()) / _SAMPLES)
        self.grid = VolumeGrid.over_box(low.tolist(), high.tolist(), spacing_mm)
        k, j, i = (axis.ravel() for axis in np.indices([*reversed(self.grid.shape)]))
        places = np.column_stack([i, j, k]) @ self.grid.affine[:3, :3].T + self.grid.affine[:3, 3]
        away = distance(places)
        close = np.abs(away) < spacing_mm
        points = places[close] - away[close, None] * normals_of(distance, places[close])
        self.surface = Surface(distance, points, spacing_mm)
        limits = near_mm, max(_BESIDE_MM, 1.5 * spacing_mm)
        self.near, self.beside = ((away > 0.0) & (away < limit) for limit in limits)

    def echo(self, scene: GaussianScene) -> tuple[float, float]:
        """Mean and deviation where Gaussians support it."""
        echo = self._sampled(scene, "echo")[self.near & (self._sampled(scene, "coverage") > SUPPORT_COVERAGE)]
        return (float(echo.mean()), float(echo.std())) if len(echo) else (_LEVEL, _ROUGHNESS)

    def coverage(self, scene: GaussianScene) -> float:
        return float(self._sampled(scene, "coverage")[self.beside].mean())

    def _sampled(self, scene: GaussianScene, name: str) -> FloatArray:
        return np.concatenate(list(sample_volume(scene, name, self.grid))).ravel()


def _without(scene: GaussianScene, radius_mm: float, around: _Around) -> GaussianScene | None:
    """What a body leaves of the scene: Gaussians that reach into it are clipped, the others stay as they are."""
    halved, distance = _halved(scene, radius_mm, around), around.surface.distance
    reached = around.surface.reached_by(halved)
    outside = [] if reached.all() else [part(halved, ~reached)]
    if reached.any():
        rest = clipped(part(halved, reached), lambda points: -distance(points), _SOFT)
        outside += [] if rest is None else [rest]
    return stacked(halved, outside) if outside else None


def _halved(scene: GaussianScene, radius_mm: float, around: _Around) -> GaussianScene:
    """The scene with Gaussians that the surface may clip, covered beside it as before.

    How much more halves cover than the whole did depends on what else lies there. So all of them shrink or grow alike,
    by as much as the secant method finds.
    """
    halved, whole = split(scene, around.surface, max(FINEST_MM, math.sqrt(2.0 * _FLATNESS_MM * radius_mm)))

    def resized(by: float) -> GaussianScene:
        scales = halved.scales.clone()
        scales[whole:] += by
        return rebuilt(halved, {**halved.splats, "scales": scales}, halved.labels)

    wanted = around.coverage(scene)
    before, off_before, by = 0.0, around.coverage(halved) - wanted, _FIRST_RESIZED
    for _ in range(_STEPS):
        off = around.coverage(resized(by)) - wanted
        if off == off_before:  # there are no halves
            return halved
        step = off * (by - before) / (off - off_before)
        before, off_before, by = by, off, min(max(by - step, -_MOST_RESIZED), _MOST_RESIZED)
    return resized(by)


def _filled(
    scene: GaussianScene, distance: Distance, bounds: tuple[FloatArray, FloatArray], sigma_mm: float, seed: int
) -> GaussianScene:
    """Round Gaussians all over a body, small at its surface, which clips them.

    Cubes about the body are divided in eight as long as they are larger than the smallest and the surface is near.
    """
    low, high = bounds
    smallest = _SPACING * sigma_mm
    side = smallest * min(_LARGEST, 2 ** int(math.log2(max(1.0, 0.5 * float((high - low).min()) / smallest))))
    counts = np.ceil((high - low) / side).astype(int) + 1
    corner = 0.5 * (low + high) - 0.5 * side * (counts - 1)
    cubes = corner + side * np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 3)
    eighths = np.stack(np.meshgrid(*3 * [[-0.25, 0.25]], indexing="ij"), axis=-1).reshape(-1, 3)
    levels = []
    while len(cubes):
        away = distance(cubes)
        near = np.abs(away) < 2.5 * side if side > 1.001 * smallest else np.zeros(len(cubes), bool)
        least = 0.0 if side > 1.001 * smallest else 0.5 * side
        kept = cubes[~near & (away < least)]
        levels.append(np.column_stack([kept, np.full(len(kept), side / _SPACING)]))
        cubes = (cubes[near][:, None] + side * eighths).reshape(-1, 3)
        side /= 2.0
    cells = np.concatenate(levels)
    shaken = cells[:, :3] + 0.15 * cells[:, 3:] * np.random.default_rng(seed).normal(size=(len(cells), 3))
    like, count = scene.means, len(cells)
    means = torch.from_numpy((shaken - np.asarray(scene.info.centre_mm)) / 10.0).to(like)
    sh0, _ = harmonics_of(torch.full((count,), 0.5))
    splats = {
        "means": means,
        "scales": torch.from_numpy(np.log(cells[:, 3:] / 10.0)).to(like).expand(count, 3).contiguous(),
        "quats": like.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4).contiguous(),
        "transmittances": like.new_zeros(count),
        "sh0": sh0.to(like),
        "shN": like.new_zeros(count, scene.shN.shape[1], 1),
    }
    body = clipped(GaussianScene.from_splats(splats, info=_place_of(scene)), distance, _SHARP)
    if body is None:
        raise InvalidArgument("shape is too small or too thin to be filled", field="shape")
    return body


def _local_mean(body: GaussianScene, values: FloatArray) -> FloatArray:  # [N] -> [N]
    """Means by volume in cubes, so that no part of a body comes out brighter than another."""
    _, cube = np.unique(np.floor(means_mm(body) / _EVEN_MM), axis=0, return_inverse=True)
    volume = body.scales.sum(dim=1).exp().cpu().double().numpy()
    means: FloatArray = (np.bincount(cube, volume * values) / np.bincount(cube, volume))[cube]
    return means


def _place_of(scene: GaussianScene) -> Any:
    """The facts of a scene that its Gaussians alone need."""
    return replace(scene.info, label_names={}, provenance={})


def _copied(
    scene: GaussianScene, edit: InsertEdit, distance: Distance, bounds: tuple[FloatArray, FloatArray]
) -> GaussianScene | None:
    """The Gaussians of another place of the scene, brought here and clipped."""
    motion = np.eye(4)
    motion[:3, 3] = 0.5 * (bounds[0] + bounds[1]) - np.asarray(edit.texture_from_mm)
    there = moved_gaussians(scene, motion)
    plain = GaussianScene.from_splats(there, info=_place_of(scene))
    body = clipped(plain, distance, _SHARP)
    if body is None or len(body.means) < _LEAST_NEAR:
        raise InvalidArgument(
            f"texture_from_mm must be a place of the scene with Gaussians, there are "
            f"{0 if body is None else len(body.means)}",
            field="texture_from_mm",
        )
    return body


def _attenuating(
    body: GaussianScene, per_cm: float, distance: Distance, bounds: tuple[FloatArray, FloatArray]
) -> GaussianScene:
    """The body with transmittances by which it takes exp(−per_cm) of each cm of a beam, or as much as it can.

    A beam loses 1 − τ of nearly Σ ψ. How much that is of a way through this body is measured: on parallel lines
    through its middle, T is what a small 1 − τ leaves.
    """
    low, high = bounds
    size = high - low
    pose = np.eye(4)
    pose[:3, 3] = 0.5 * (low + high)
    pose[2, 3] = low[2] - 1.0
    probe = LinearProbe(width_mm=float(size[0]), near_mm=0.0, far_mm=float(size[2]) + 2.0)
    trial = _with_transmittance(body, 1.0 - _TRIAL)
    frame = render(trial, probe, pose, height=_LINES, width=_LINES, outputs=("transmittance",), beam=PLANE)
    lost = -np.log(frame["transmittance"][0, -1].double().cpu().numpy()) / _TRIAL  # [W]
    origins, directions = probe.scan_lines(_LINES)
    points = (origins + probe.depths_mm(_LINES)[:, None, None] * directions).reshape(-1, 3) + pose[:3, 3]
    inside = (distance(points) < 0.0).reshape(_LINES, _LINES)
    ways_cm = inside.sum(axis=0) * (probe.far_mm / _LINES) / 10.0  # [W]
    ended = per_cm * ways_cm.sum() / max(float(lost.sum()), 1e-9)
    return _with_transmittance(body, 1.0 - min(ended, 1.0))


def _with_transmittance(body: GaussianScene, tau: float) -> GaussianScene:
    logit = math.log((tau + 1e-6) / (1.0 - tau + 1e-6))
    return rebuilt(body, {**body.splats, "transmittances": torch.full_like(body.transmittances, logit)}, body.labels)


def draw_lesions(scene: GaussianScene, edit: LesionsEdit) -> list[InsertEdit]:
    """Random bodies within what the training images show, apart from each other. The same for the same seed.

    Raises InvalidArgument for a scene without training poses or probe, and where there is no place for as many.
    """
    probe, poses = scene.info.probe, scene.at_rest().training_poses
    if probe is None or not len(poses):
        raise InvalidArgument("lesions need a scene that knows its training poses and its probe", field="kind")
    random, places = np.random.default_rng(edit.seed), means_mm(scene)
    origins, directions = probe.scan_lines(64)
    depths = probe.depths_mm(64)
    lesions: list[InsertEdit] = []
    taken: list[tuple[FloatArray, float]] = []
    for _ in range(_TRIES * edit.count):
        tissue = edit.tissues[random.integers(len(edit.tissues))]
        largest = random.uniform(edit.radius_min_mm, edit.radius_max_mm)
        if tissue == "calcification":
            largest *= _CALCIFICATION
        line, depth = random.integers(8, 56), depths[random.integers(8, 52)]
        pose = poses[random.integers(len(poses))]
        middle = pose[:3, :3] @ (origins[line] + depth * directions[line]) + pose[:3, 3]
        radii = np.maximum(largest * random.uniform(0.6, 1.0, 3), 0.5)
        turn = random.uniform(-90.0, 90.0, 3)
        near = np.linalg.norm(places - middle, axis=1) < largest + _NEAR_MM
        apart = all(np.linalg.norm(middle - other) > 1.5 * (largest + reach) for other, reach in taken)
        if near.sum() < _LEAST_NEAR or not apart:
            continue
        taken.append((middle, largest))
        shape: Shape = EllipsoidShape(centre_mm=_triple(middle), radii_mm=_triple(radii), turn_deg=_triple(turn))
        imaging: dict[str, Any] = {"frequency_mhz": edit.frequency_mhz, "dynamic_range_db": edit.dynamic_range_db}
        seed = int(random.integers(2**31))
        lesions.append(InsertEdit(shape=shape, tissue=tissue, seed=seed, **imaging))
        if len(lesions) == edit.count:
            return lesions
    raise InvalidArgument(
        f"the scene has room for {len(lesions)} lesions of this size, {edit.count} are asked for", field="count"
    )


def _triple(values: FloatArray) -> tuple[float, float, float]:  # [3]
    x, y, z = np.round(values, 3).tolist()
    return x, y, z
