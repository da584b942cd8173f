"""Checks of a data set before anything is trained from it: what is in it, how well its planes fill the volume, and
what looks wrong.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ultragray.geometry.pose import rotation_angles_deg
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.geometry.rotations import turns_of
from ultragray.learn.sweep import Dataset, Distances, Sweep, corner_distances_mm

VOXEL_MM = 1.0
MAX_VOXELS = 8_000_000
GROWTH = 1.01  # of voxels that are still too many
MAX_POINTS = 200_000  # of one image plane


@dataclass(frozen=True)
class SweptVolume:
    """Voxels crossed by any image plane, in the box around all planes along the axes of the middle frame."""

    swept_ml: float
    coverage: float  # crossed voxels / voxels of the box
    voxel_mm: float


def swept_volume(sweep: Sweep) -> SweptVolume:
    """Counts the voxels of 1 mm (more for volumes over eight litres) that image planes of the sweep cross."""
    axes = sweep.poses[len(sweep) // 2, :3, :3]
    corners = sweep.corners_mm() @ axes
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    voxel_mm = max(VOXEL_MM, float(np.prod(np.maximum(high - low, VOXEL_MM)) / MAX_VOXELS) ** (1 / 3))
    while _counts(high - low, voxel_mm).prod() > MAX_VOXELS:  # a side thinner than a voxel still takes one
        voxel_mm *= GROWTH
    counts = _counts(high - low, voxel_mm).astype(np.int64)
    crossed = np.zeros(counts.prod(), bool)
    points = _plane_points(sweep.probe, voxel_mm / 2)
    for pose in sweep.poses:
        places = ((points @ pose[:3, :3].T + pose[:3, 3]) @ axes - low) / voxel_mm
        x, y, z = np.clip(places.astype(np.int64), 0, counts - 1).T
        crossed[(x * counts[1] + y) * counts[2] + z] = True
    share = float(crossed.mean())
    return SweptVolume(swept_ml=float(crossed.sum()) * voxel_mm**3 / 1000.0, coverage=share, voxel_mm=voxel_mm)


def _counts(span_mm: FloatArray, voxel_mm: float) -> FloatArray:  # [3]
    return np.maximum(np.ceil(span_mm / voxel_mm - 1e-9), 1.0)


def _plane_points(probe: Probe, spacing_mm: float) -> FloatArray:  # [P, 3]
    """Points on the image plane, at most `spacing_mm` apart where their number allows."""
    sides_mm = probe.lines.breadth_mm(probe.far_mm), probe.scan_line_length_mm
    lines, samples = (max(2, math.ceil(side_mm / spacing_mm)) for side_mm in sides_mm)
    thinning = max(1.0, math.sqrt(lines * samples / MAX_POINTS))
    lines, samples = math.ceil(lines / thinning), math.ceil(samples / thinning)
    origins, directions = probe.scan_lines(lines)
    points: FloatArray = origins[:, None] + probe.depths_mm(samples)[None, :, None] * directions[:, None]
    return points.reshape(-1, 3)


# Checks of a dataset: its contents in numbers, and what looks wrong about it.
#
# What cannot be used at all is refused when a dataset is read (`Sweep`, `Dataset`); warnings leave the choice to a
# person.


JUMP_FACTOR = 5.0  # times the usual step
JUMP_SPREADS = 8.0  # standard deviations, estimated from the median
SMALLEST_JUMP_MM = 1.0
SATURATED_SHARE = 0.05
DARKEST_PEAK = 16  # of 255
SAME_POSE_MM = 1e-6
SHORTEST_TRAVEL = 0.1  # of the length of the scan lines
TURN_IN_PLACE_DEG = 5.0
MAX_TILT_FRAMES = 300


@dataclass(frozen=True)
class SweepReport:
    """One part of a dataset. A step goes from a frame to the next; its length is the mean travel of the corners."""

    source: str
    frames: int
    height: int
    width: int
    pixel_axial_mm: float
    pixel_lateral_mm: float
    extent_min_mm: tuple[float, float, float]  # of the corners, tracker frame
    extent_max_mm: tuple[float, float, float]
    path_mm: float  # travel of the probe's origin
    step_median_mm: float
    step_max_mm: float
    step_max_deg: float
    tilt_deg: float  # largest angle between two frames
    tilt_range_deg: tuple[float, float, float]  # about the lateral, elevation and axial axis of the middle frame
    swept_ml: float  # voxels that a frame crosses
    coverage: float  # their share of the box around the frames, along the axes of the middle frame
    voxel_mm: float
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class DatasetReport:
    """A whole dataset; `val` is None where nothing is held out."""

    name: str
    sha256: str
    probe: Probe
    train: SweepReport
    val: SweepReport | None
    val_distance_median_mm: float | None  # to the nearest training frame: mean distance of the corners
    val_distance_max_mm: float | None
    val_angle_max_deg: float | None  # to that nearest frame
    warnings: tuple[str, ...]

    @property
    def labelled_warnings(self) -> tuple[str, ...]:
        """Every warning, the part that it is about first."""
        return (
            *(f"train: {text}" for text in self.train.warnings),
            *(f"val: {text}" for text in (self.val.warnings if self.val else ())),
            *self.warnings,
        )


def check_dataset(dataset: Dataset) -> DatasetReport:
    """Describe both parts and how far the held-out frames lie from the training frames."""
    away = Distances.of(dataset)
    distances, angles = away.mm, away.deg
    return DatasetReport(
        name=dataset.name,
        sha256=dataset.sha256,
        probe=dataset.probe,
        train=check_sweep(dataset.train),
        val=check_sweep(dataset.val) if len(dataset.val) else None,
        val_distance_median_mm=float(np.median(distances)) if len(distances) else None,
        val_distance_max_mm=float(distances.max()) if len(distances) else None,
        val_angle_max_deg=float(angles.max()) if len(angles) else None,
        warnings=tuple(_dataset_warnings(dataset)),
    )


def check_sweep(sweep: Sweep) -> SweepReport:
    """Describe the frames of a sweep (at least one) and list what looks wrong, with frame numbers."""
    corners = sweep.corners_mm()
    steps_mm = corner_distances_mm(corners[:-1], corners[1:])
    steps_deg = np.array([rotation_angles_deg(a[None], b[None])[0, 0] for a, b in pairwise(sweep.poses)])
    thinned = sweep.poses[:: -(-len(sweep) // MAX_TILT_FRAMES)]
    swept = swept_volume(sweep)
    axial_mm, lateral_mm = sweep.pixel_mm
    origins = sweep.poses[:, :3, 3]
    turns = turns_of(sweep.poses[len(sweep) // 2, :3, :3].T @ sweep.poses[:, :3, :3])
    return SweepReport(
        source=sweep.source,
        frames=len(sweep),
        height=sweep.height,
        width=sweep.width,
        pixel_axial_mm=axial_mm,
        pixel_lateral_mm=lateral_mm,
        extent_min_mm=_vector(corners.min(axis=(0, 1))),
        extent_max_mm=_vector(corners.max(axis=(0, 1))),
        path_mm=float(np.linalg.norm(np.diff(origins, axis=0), axis=1).sum()),
        step_median_mm=float(np.median(steps_mm)) if len(steps_mm) else 0.0,
        step_max_mm=float(steps_mm.max(initial=0.0)),
        step_max_deg=float(steps_deg.max(initial=0.0)),
        tilt_deg=float(rotation_angles_deg(thinned, thinned).max()),
        tilt_range_deg=_vector(np.ptp(np.degrees(turns), axis=0)),
        swept_ml=swept.swept_ml,
        coverage=swept.coverage,
        voxel_mm=swept.voxel_mm,
        warnings=(*_jumps(sweep, steps_mm), *_repeats(sweep), *_odd_images(sweep)),
    )


def _vector(values: FloatArray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _jumps(sweep: Sweep, steps_mm: FloatArray) -> list[str]:
    """Steps far longer than usual: a frame off its two neighbours, or a gap such as between two sweeps."""
    gaps = np.abs(np.diff(sweep.frame_numbers)).clip(min=1)
    speeds = steps_mm / gaps
    if len(speeds) < 3:
        return []
    usual = float(np.median(speeds))
    spread = 1.4826 * float(np.median(np.abs(speeds - usual)))
    limit = max(JUMP_FACTOR * usual, usual + JUMP_SPREADS * spread, SMALLEST_JUMP_MM)
    jumps = [int(place) for place in np.flatnonzero(speeds > limit)]
    numbers, found, skip = sweep.frame_numbers, [], -1
    for place in jumps:
        if place == skip:
            continue
        if place + 1 in jumps:
            found.append(
                f"frame {numbers[place + 1]} lies {steps_mm[place]:.1f} mm off the frame before and "
                f"{steps_mm[place + 1]:.1f} mm off the one after it, where {usual:.2g} mm are usual: a wrong pose?"
            )
            skip = place + 1
        else:
            found.append(
                f"a jump of {steps_mm[place]:.1f} mm from frame {numbers[place]} to {numbers[place + 1]}, where "
                f"{usual:.2g} mm are usual: another sweep, or lost tracking?"
            )
    return found


def _repeats(sweep: Sweep) -> list[str]:
    poses = np.round(sweep.poses / SAME_POSE_MM).astype(np.int64)
    found = []
    for places in _groups(poses):
        if len({_digest(sweep.images[place]) for place in places}) == 1:
            found.append(f"frames {_list(sweep, places)} are the same frame: one pose, one image")
        else:
            found.append(f"frames {_list(sweep, places)} share one pose, but show different images: tracking stalled?")
    for places in _groups(sweep.images):
        if len({_digest(poses[place]) for place in places}) > 1:
            found.append(f"frames {_list(sweep, places)} show one image at different poses: a frozen picture?")
    return found


def _groups(arrays: np.ndarray) -> list[list[int]]:
    """Places whose arrays are equal, in groups of two and more."""
    places: dict[bytes, list[int]] = {}
    for place, array in enumerate(arrays):
        places.setdefault(_digest(array), []).append(place)
    return [group for group in places.values() if len(group) > 1]


def _digest(array: np.ndarray) -> bytes:
    return hashlib.blake2b(np.ascontiguousarray(array).reshape(-1).data, digest_size=16).digest()


def _odd_images(sweep: Sweep) -> list[str]:
    def where(is_odd: Callable[[np.ndarray], bool]) -> list[int]:
        return [place for place, image in enumerate(sweep.images) if is_odd(image)]

    found = []
    if dark := where(lambda image: bool(image.max() < DARKEST_PEAK)):
        found.append(f"frames {_list(sweep, dark)} are nearly black: no pixel reaches {DARKEST_PEAK} of 255")
    if bright := where(lambda image: float(np.mean(image == 255)) > SATURATED_SHARE):
        found.append(f"frames {_list(sweep, bright)} are saturated: over {SATURATED_SHARE:.0%} of the pixels are 255")
    return found


def _dataset_warnings(dataset: Dataset) -> list[str]:
    found = [
        *dict.fromkeys((*dataset.train.notes, *dataset.val.notes)),
        *(list(dataset.probe.oddities()) or _hardly_moved(dataset.train)),
    ]
    known = set(_contents(dataset.train))
    leaked = [place for place, frame in enumerate(_contents(dataset.val)) if frame in known]
    if leaked:
        found.append(f"held-out frames {_list(dataset.val, leaked)} are also training frames: metrics will flatter")
    return found


def _hardly_moved(sweep: Sweep) -> list[str]:
    """A probe that stays where it is, as poses in metres or centimetres have it."""
    travel_mm = float(np.linalg.norm(np.ptp(sweep.poses[:, :3, 3], axis=0)))
    pixel_mm, usual_mm = min(sweep.pixel_mm), SHORTEST_TRAVEL * sweep.probe.scan_line_length_mm
    if travel_mm >= max(pixel_mm, usual_mm):
        return []
    turn_deg = float(rotation_angles_deg(sweep.poses[[0]], sweep.poses).max())
    found = f"the poses of all {len(sweep)} training frames lie within {travel_mm:.2g} mm"
    if turn_deg >= TURN_IN_PLACE_DEG:
        return [f"{found} and turn by {turn_deg:.0f}°: a probe tilted in place, or positions not in millimetres?"]
    if travel_mm < pixel_mm:
        return [f"{found}, less than a pixel ({pixel_mm:.2g} mm): tracking stalled, or positions in metres?"]
    return [f"{found}, where scan lines are {sweep.probe.scan_line_length_mm:.0f} mm long: positions in centimetres?"]


def _contents(sweep: Sweep) -> list[tuple[bytes, bytes]]:
    return [(_digest(image), _digest(pose)) for image, pose in zip(sweep.images, sweep.poses, strict=True)]


def _list(sweep: Sweep, places: Sequence[int]) -> str:
    """Frame numbers as text, at most ten of them."""
    numbers = [str(sweep.frame_numbers[place]) for place in places]
    return ", ".join(numbers[:10]) + (f" and {len(numbers) - 10} more" if len(numbers) > 10 else "")
