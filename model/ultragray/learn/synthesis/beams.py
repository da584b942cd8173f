"""The sweep of a recipe: its poses, and what its beams lose on their way.

A scanner shows decibels: a tissue of grey level g, at a place to which the beam has lost L dB there and back more than
the time-gain compensation takes out, shows B = g − L / dynamic range. The model multiplies: B = E·T. Along a beam both
agree where −d log T / ds = (dL/ds) / (dynamic range · B), and what is left between them, where B jumps from tissue to
tissue and where L falls because fluid attenuates less than is compensated, goes into the echo, E = B/T. So frames of
the sweep show what physics says, and from elsewhere shadows fall as the beam then runs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from ultragray.errors import InvalidArgument
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import BoolArray, FloatArray, Probe
from ultragray.learn.sweep import spread_places
from ultragray.learn.synthesis.space import BodySpace
from ultragray.scene.recipes import SceneRecipe

Float32Array: TypeAlias = npt.NDArray[np.float32]

POSES, LINES, STEP_MM = 80, 96, 0.5  # of the sweep that are followed at most, lines of each, and a step along them
CELL_MM = 1.0  # of the grid on which losses are known
NARROW, WIDE = 0.8, 2.0  # cells: of blurs, among beams and beyond the last ones
MARGIN_MM = 3.0 * WIDE * CELL_MM  # around what the sweep shows, for Gaussians that are seen from within
DARK = 0.1  # least grey level that absorption is reckoned from
MOST_RANGES = 2.0  # a beam that has lost so many dynamic ranges is gone


def scan_poses(space: BodySpace, recipe: SceneRecipe) -> FloatArray:  # [P, 4, 4] mm
    """A sweep along `along`, its face on the first body that the middle of its beam meets. Raises InvalidArgument."""
    towards, along = (np.asarray(getattr(recipe, name), np.float64) for name in ("towards", "along"))
    length = np.linalg.norm(towards)
    towards = towards / max(float(length), 1e-9)
    along = along - (along @ towards) * towards
    if length < 1e-6 or np.linalg.norm(along) < 1e-6:
        raise InvalidArgument("towards and along must be two directions, not the same", field="towards")
    along /= np.linalg.norm(along)
    middle = 0.5 * (space.low_mm + space.high_mm) if recipe.middle_mm is None else np.asarray(recipe.middle_mm)
    reach = float(np.linalg.norm(space.high_mm - space.low_mm) + np.linalg.norm(middle - space.low_mm))
    steps = np.arange(-reach, reach, 0.5 * space.resolution_mm)
    poses = np.tile(np.eye(4), (recipe.pose_count, 1, 1))
    poses[:, :3, :3] = np.stack([np.cross(along, towards), along, towards], axis=1)
    offsets = recipe.sweep_mm * (np.linspace(-0.5, 0.5, recipe.pose_count) if recipe.pose_count > 1 else np.zeros(1))
    for pose, offset in zip(poses, offsets, strict=True):
        line = middle + offset * along + steps[:, None] * towards
        met = np.flatnonzero(space.number_at(line))
        if not len(met):
            raise InvalidArgument(f"the sweep meets no body {offset:g} mm from its middle", field="sweep_mm")
        pose[:3, 3] = line[met[0]] - recipe.scanner.face_depth_mm * towards
    return check_poses(poses)


@dataclass(frozen=True, eq=False)
class Losses:
    """What beams have lost, on a grid over all that the sweep shows."""

    low_mm: FloatArray  # [3] middle of the first cell
    seen: FloatArray  # [I, J, K] above 0 where the sweep shows anything
    lost_db: FloatArray  # there and back, over what is compensated; below 0: less than that
    depth: FloatArray  # −log of the model's transmittance

    @property
    def high_mm(self) -> FloatArray:
        return self.low_mm + CELL_MM * (np.array(self.seen.shape) - 1)

    def shows(self, points: FloatArray) -> BoolArray:  # [N, 3] mm -> [N]
        is_seen: BoolArray = self._at(points, self.seen) > 1e-6
        return is_seen

    def at(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:  # [N, 3] mm -> [N], [N]
        """Decibels lost, and −log T."""
        return self._at(points, self.lost_db), self._at(points, self.depth)

    def _at(self, points: FloatArray, field: FloatArray) -> FloatArray:
        return interpolated(field, (points - self.low_mm) / CELL_MM)


def interpolated(field: npt.NDArray[Any], places: FloatArray) -> FloatArray:  # [I, J, K], [N, 3] in cells -> [N]
    """The value between the middles of cells; beyond the border that of the border."""
    last = np.array(field.shape) - 1
    places = np.clip(places, 0.0, last)
    first = np.minimum(places.astype(np.int64), np.maximum(last - 1, 0))
    share = places - first
    values = np.zeros(len(places), field.dtype)
    for corner in np.argwhere(np.ones((2, 2, 2))):
        weight = np.where(corner > 0, share, 1.0 - share).prod(axis=1)
        values += weight.astype(field.dtype) * field[tuple(np.minimum(first + corner, last).T)]
    return values


def losses(space: BodySpace, recipe: SceneRecipe, poses: FloatArray) -> Losses:  # poses [P, 4, 4] mm
    """What the beams of a sweep lose, each followed line by line; where several come by, their mean."""
    probe, tissues = recipe.scanner, [body.acoustics for body in space.bodies]
    grey = np.array([0.0, *(recipe.level + one.echo_db / recipe.dynamic_range_db for one in tissues)]).clip(0.0, 1.0)
    excess = np.array([0.0, *(one.attenuation - recipe.compensated for one in tissues)])
    per_step = 2.0 * recipe.frequency_mhz * excess * STEP_MM / 10.0  # dB
    low, high = _seen_box(space, probe, poses)
    shape = np.ceil((high - low) / CELL_MM).astype(int) + 1
    sums = np.zeros((3, int(shape.prod())))
    for place in spread_places(len(poses), min(POSES, len(poses))):
        points = _along_lines(probe, poses[place])  # [R, W, 3]
        number = space.number_at(points.reshape(-1, 3)).reshape(points.shape[:2])
        lost = np.cumsum(per_step[number], axis=0) - 0.5 * per_step[number]
        brightness = np.maximum(grey[number] - lost / recipe.dynamic_range_db, DARK)
        ended = np.maximum(per_step[number], 0.0) / (recipe.dynamic_range_db * brightness)
        depth = np.cumsum(ended, axis=0) - 0.5 * ended
        cells = np.rint((points - low) / CELL_MM).astype(np.int64)
        inside = ((cells >= 0) & (cells < shape)).all(axis=-1)
        flat = np.ravel_multi_index(tuple(cells[inside].T), tuple(shape))
        most = MOST_RANGES * recipe.dynamic_range_db
        for total, values in zip(sums, (np.ones_like(lost), lost.clip(-most, most), depth), strict=True):
            total += np.bincount(flat, values[inside], minlength=len(total))
    narrow, wide = (
        [blurred(total.reshape(shape).astype(np.float32), cells) for total in sums] for cells in (NARROW, WIDE)
    )
    known = narrow[0] > 1e-3
    count, lost_db, depth = (np.where(known, one, other) for one, other in zip(narrow, wide, strict=True))
    least = np.maximum(count, 1e-9)
    return Losses(low, count, lost_db / least, depth / least)


def _seen_box(space: BodySpace, probe: Probe, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    ends = np.concatenate([_along_lines(probe, pose)[[0, -1]].reshape(-1, 3) for pose in poses])
    low, high = np.maximum(ends.min(axis=0), space.low_mm), np.minimum(ends.max(axis=0), space.high_mm)
    return low - MARGIN_MM, high + MARGIN_MM


def _along_lines(probe: Probe, pose: FloatArray) -> FloatArray:  # [4, 4] mm -> [R, W, 3]
    origins, directions = probe.scan_lines(LINES)
    depths = probe.face_depth_mm + STEP_MM * (0.5 + np.arange(int((probe.far_mm - probe.face_depth_mm) / STEP_MM)))
    local = origins + depths[:, None, None] * directions
    points: FloatArray = local @ pose[:3, :3].T + pose[:3, 3]
    return points


def blurred(field: Float32Array, sigma: float) -> Float32Array:  # [I, J, K], in cells
    """Under a Gaussian along each axis."""
    reach = max(1, int(np.ceil(3.0 * sigma)))
    kernel = np.exp(-0.5 * np.square(np.arange(-reach, reach + 1) / sigma)).astype(np.float32)
    kernel /= kernel.sum()
    for axis in range(3):
        rows: Any = np.moveaxis(field, axis, 0)
        flat = np.ascontiguousarray(rows).reshape(rows.shape[0], -1)
        smooth = cv2.sepFilter2D(flat, -1, np.ones(1, np.float32), kernel, borderType=cv2.BORDER_REPLICATE)
        field = np.moveaxis(np.asarray(smooth, np.float32).reshape(rows.shape), 0, axis)
    return np.ascontiguousarray(field)
