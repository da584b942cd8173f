"""Checks of a data set before anything is trained from it: what is in it, how well its planes fill the volume, and
what looks wrong.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, pairwise

import cv2
import numpy as np
import numpy.typing as npt

from ultragray.contract import made_of
from ultragray.datasets.causes import PathReport
from ultragray.datasets.clocks import DelayEstimate, clock_warnings, estimate_delay, goes_to_and_fro_mm
from ultragray.datasets.images import CropBox
from ultragray.geometry.probe import Fan, FloatArray, Probe
from ultragray.geometry.rotations import rotation_angles_deg, turns_of
from ultragray.learn.marks import LEAST_PICTURES, burnt_in
from ultragray.learn.sweep import REST, Chain, Dataset, Distances, Sweep, corner_distances_mm, frame_list, usual_step
from ultragray.learn.training.agreement import agreed_path

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
SMALLEST_TURN_DEG = 20.0
SATURATED_SHARE = 0.05
DARKEST_PEAK = 16  # of 255
SAME_POSE_MM = 1e-6
SHORTEST_TRAVEL = 0.1  # of the length of the scan lines
TURN_IN_PLACE_DEG = 5.0
LONGEST_USUAL_STEP_MM = 50.0
MAX_TILT_FRAMES = 300
THUMBNAIL = (32, 32)
MOST_REPEATS = 3  # of one kind that are told one by one: more in one sentence
FLAT = 2.0  # levels, standard deviation of a thumbnail: below, it is black or noise, and its looks say little
CUT_FACTOR, SMALLEST_CUT = 8.0, 0.15  # of one minus the correlation of two pictures
LEAST_MARKS, MAX_BOXES = 12, 3  # pixels of a mark that is told, and how many marks
MARGIN = 2  # pixels around marks whose edges are smoothed


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
    chain: Chain  # from pixels to the frame of the poses
    image_delay_ms: float | None  # of the images to the poses, as path and pictures tell it
    path: PathReport | None  # what neighbouring frames tell of their poses; None: no three frames in a row
    warnings: tuple[str, ...]  # all of them, those of one part with its name


def check_dataset(dataset: Dataset) -> DatasetReport:
    """Describe both parts and how far the held-out frames lie from the training frames.

    Two parts of one recording are judged together, in the order of its frames.
    """
    away = Distances.of(dataset)
    distances, angles = away.mm, away.deg
    train, val = dataset.train, dataset.val
    recording = _Frames(train, val) if dataset.is_one_recording else _Frames(train)
    delay = recording.delay()
    reports = {"train": check_sweep(train), **({"val": check_sweep(val)} if len(val) else {})}
    if dataset.is_one_recording:
        found = list(_warnings(recording))
        reports = {name: replace(report, warnings=()) for name, report in reports.items()}
    else:
        found = [f"{name}: {text}" for name, report in reports.items() for text in report.warnings]
    if delay is not None:
        found.append(
            f"images seem to come {abs(delay.delay_ms):.0f} ms {'after' if delay.delay_ms > 0 else 'before'} their "
            f"poses: path and pictures fit so ({delay.unexplained:.0%} unexplained, {delay.without:.0%} without): "
            f"--image-delay-ms {delay.delay_ms:.0f} corrects it"
        )
    found_path = agreed_path(dataset)
    path = None if found_path is None else PathReport.of(found_path, dataset.probe)
    if path is not None and any(_moved_far(recording)):
        path = replace(path, warnings=())  # what is found of positions in other units has no such cause
    return DatasetReport(
        name=dataset.name,
        sha256=dataset.sha256,
        probe=dataset.probe,
        train=reports["train"],
        val=reports.get("val"),
        val_distance_median_mm=float(np.median(distances)) if len(distances) else None,
        val_distance_max_mm=float(distances.max()) if len(distances) else None,
        val_angle_max_deg=float(angles.max()) if len(angles) else None,
        chain=train.chain,
        image_delay_ms=None if delay is None else delay.delay_ms,
        path=path,
        warnings=(*found, *_dataset_warnings(dataset, path)),
    )


class _Frames:
    """The frames of sweeps in the order of their numbers, without a copy of the images."""

    def __init__(self, *sweeps: Sweep) -> None:
        numbers = np.concatenate([sweep.frame_numbers for sweep in sweeps])
        order = np.argsort(numbers, kind="stable") if len(sweeps) > 1 else np.arange(len(numbers))
        places = [(sweep, place) for sweep in sweeps for place in range(len(sweep))]
        self.numbers = numbers[order]
        self.poses = np.concatenate([sweep.poses for sweep in sweeps])[order]
        self.corners = np.concatenate([sweep.corners_mm() for sweep in sweeps])[order]
        self.region, self.probe = sweeps[0].region, sweeps[0].probe
        self._places = [places[place] for place in order]
        times = [sweep.times_s for sweep in sweeps if sweep.times_s is not None]
        self.times_s = np.concatenate(times)[order] if len(times) == len(sweeps) else None
        self.steps_mm = corner_distances_mm(self.corners[:-1], self.corners[1:])

    def images(self) -> Iterator[np.ndarray]:
        return (sweep.images[place] for sweep, place in self._places)

    def image(self, frame: int) -> np.ndarray:
        sweep, place = self._places[frame]
        found: np.ndarray = sweep.images[place]
        return found

    @cached_property
    def thumbnails(self) -> npt.NDArray[np.float32]:  # [F, P] without mean, of length 1, or less where they are FLAT
        small = [cv2.resize(one, THUMBNAIL, interpolation=cv2.INTER_AREA).ravel() for one in self.images()]
        looks = np.array(small, np.float32)
        looks -= looks.mean(axis=1, keepdims=True)
        looks /= np.maximum(np.linalg.norm(looks, axis=1, keepdims=True), FLAT * math.sqrt(looks.shape[1]))
        return looks

    def changes(self, first: slice, second: slice) -> npt.NDArray[np.float32]:
        """One minus the correlation of pictures in pairs; of two flat ones, little."""
        ones, others = self.thumbnails[first], self.thumbnails[second]
        products, *squares = (np.einsum("fp,fp->f", *pair) for pair in ((ones, others), (ones, ones), (others, others)))
        found: npt.NDArray[np.float32] = sum(squares) / 2.0 - products
        return found

    def delay(self) -> DelayEstimate | None:
        """How late the images are, where the frames have times and the motion tells it."""
        if self.times_s is None or len(self.times_s) < 2:
            return None
        _, places = np.unique(self.times_s, return_index=True)
        return estimate_delay(self.thumbnails[places].astype(np.float64), self.corners[places], self.times_s[places])


def check_sweep(sweep: Sweep) -> SweepReport:
    """Describe the frames of a sweep (at least one) and list what looks wrong, with frame numbers."""
    frames = _Frames(sweep)
    corners, steps_mm = frames.corners, frames.steps_mm
    steps_deg = np.array([rotation_angles_deg(a[None], b[None])[0, 0] for a, b in pairwise(sweep.poses)])
    thinned = sweep.poses[:: -(-len(sweep) // MAX_TILT_FRAMES)]
    swept = swept_volume(sweep)
    axial_mm, lateral_mm = sweep.pixel_mm
    origins = sweep.poses[:, :3, 3]
    turns = turns_of(sweep.poses[len(sweep) // 2, :3, :3].T @ sweep.poses[:, :3, :3])
    return made_of(
        SweepReport,
        sweep,
        swept,
        frames=len(sweep),
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
        warnings=tuple(_warnings(frames)),
    )


def _vector(values: FloatArray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _warnings(frames: _Frames) -> Iterator[str]:
    """What looks wrong about the frames of one recording."""
    if frames.times_s is not None:
        yield from clock_warnings(frames.times_s, frames.numbers)
    yield from _moved_far(frames)
    yield from _to_and_fro(frames)
    jumps = sorted(_jumps(frames))
    steps = {step for some, _ in jumps for step in some}
    yield from (text for _, text in jumps)
    yield from _turned(frames, steps)
    yield from _repeats(frames)
    yield from _odd_images(frames)
    yield from _cuts(frames, steps)
    yield from _overlays(frames)


def _moved_far(frames: _Frames) -> Iterator[str]:
    """Steps that no hand makes, as millimetres have it that are taken for metres."""
    steps_mm = np.linalg.norm(np.diff(frames.poses[:, :3, 3], axis=0), axis=1)
    usual = float(np.median(steps_mm / np.abs(np.diff(frames.numbers)).clip(min=1))) if len(steps_mm) > 2 else 0.0
    if usual >= LONGEST_USUAL_STEP_MM:
        yield (
            f"the probe goes {usual:.0f} mm from frame to frame, {steps_mm.sum() / 1000:.3g} m in all: positions in "
            "millimetres where metres are expected?"
        )


def _to_and_fro(frames: _Frames) -> Iterator[str]:
    far_mm = goes_to_and_fro_mm(frames.corners.mean(axis=1))
    if far_mm:
        yield (
            f"the probe goes {far_mm:.3g} mm to and fro from frame to frame: two trackers, or two sweeps, recorded in "
            "turn?"
        )


def _turned(frames: _Frames, jumps: set[int]) -> Iterator[str]:
    """Single frames turned against both neighbours, which agree: of a small image, or beside long steps, the corners
    do not tell it."""
    turns = [rotation_angles_deg(a[None], b[None])[0, 0] for a, b in pairwise(frames.poses)]
    limit = max(SMALLEST_TURN_DEG, JUMP_FACTOR * float(np.median(turns))) if turns else 0.0
    for place in range(1, len(turns)):
        around = rotation_angles_deg(frames.poses[[place - 1]], frames.poses[[place + 1]])[0, 0]
        if min(turns[place - 1 : place + 1]) > max(limit, 2 * around) and not jumps & {place - 1, place}:
            yield (
                f"frame {frames.numbers[place]} is turned by {turns[place - 1]:.0f}° against the frame before and by "
                f"{turns[place]:.0f}° against the one after it: a wrong pose?"
            )


def _jumps(frames: _Frames) -> Iterator[tuple[list[int], str]]:
    """Steps far longer than usual, by the frames before them: of a frame off its two neighbours, of a gap such as
    between two sweeps, or of a probe that goes far for a while."""
    numbers, steps_mm, corners = frames.numbers, frames.steps_mm, frames.corners
    speeds = steps_mm / np.abs(np.diff(numbers)).clip(min=1)
    if len(speeds) < 3:
        return
    if not (usual := usual_step(speeds)):
        return
    spread = 1.4826 * float(np.median(np.abs(speeds[speeds > REST * usual] - usual)))
    limit = max(JUMP_FACTOR * usual, usual + JUMP_SPREADS * spread, SMALLEST_JUMP_MM)
    jumps = np.flatnonzero(speeds > limit).tolist()
    for before, after in pairwise(list(jumps)):
        is_pair = after == before + 1 and before in jumps  # no part of the pair before
        if is_pair and corner_distances_mm(corners[before], corners[after + 1]) < steps_mm[[before, after]].max():
            yield (
                [before, after],
                f"frame {numbers[after]} lies {steps_mm[before]:.1f} mm off the frame before and "
                f"{steps_mm[after]:.1f} mm off the one after it, where {usual:.2g} mm are usual: a wrong pose?",
            )
            jumps = [place for place in jumps if place not in (before, after)]
    for run in np.split(np.array(jumps, np.int64), np.flatnonzero(np.diff(jumps) > 1) + 1) if jumps else ():
        first, last, longest_mm = numbers[run[0]], numbers[run[-1] + 1], steps_mm[run].max()
        yield (
            run.tolist(),
            f"a jump of {longest_mm:.1f} mm from frame {first} to {last}, where {usual:.2g} mm are usual: another "
            "sweep, or lost tracking?"
            if len(run) == 1
            else f"steps of up to {longest_mm:.1f} mm from frame {first} to {last}, where {usual:.2g} mm are usual: a "
            "probe lifted off or turned, or lost tracking?",
        )


def _repeats(frames: _Frames) -> Iterator[str]:
    numbers = frames.numbers
    poses = np.round(frames.poses / SAME_POSE_MM).astype(np.int64)
    images = [_digest(image) for image in frames.images()]
    of_poses, of_images = _groups([_digest(pose) for pose in poses]), _groups(images)
    same = [places for places in of_poses if len({images[place] for place in places}) == 1]
    stalled = [places for places in of_poses if places not in same]
    frozen = [places for places in of_images if len({_digest(poses[place]) for place in places}) > 1]
    for groups, what in (
        (same, "are the same frame: one pose, one image"),
        (stalled, "share one pose, but show different images: tracking stalled?"),
        (frozen, "show one image at different poses: a frozen picture?"),
    ):
        if len(groups) <= MOST_REPEATS:
            yield from (f"frames {frame_list(numbers[places])} {what}" for places in groups)
            continue
        listed = frame_list(numbers[sorted(chain(*groups))])
        fewest, most = (limit(map(len, groups)) for limit in (min, max))
        size = f"{fewest}" if fewest == most else f"{fewest} to {most}"
        yield f"{len(groups)} times {size} frames (of {listed}) {what}"


def _groups(digests: Sequence[bytes]) -> list[list[int]]:
    """Places whose digests are equal, in groups of two and more."""
    places: dict[bytes, list[int]] = {}
    for place, digest in enumerate(digests):
        places.setdefault(digest, []).append(place)
    return [group for group in places.values() if len(group) > 1]


def _digest(array: np.ndarray) -> bytes:
    return hashlib.blake2b(np.ascontiguousarray(array).reshape(-1).data, digest_size=16).digest()


def _odd_images(frames: _Frames) -> Iterator[str]:
    dark = [place for place, image in enumerate(frames.images()) if image.max() < DARKEST_PEAK]
    bright = [place for place, image in enumerate(frames.images()) if np.mean(image == 255) > SATURATED_SHARE]
    if dark:
        yield f"frames {frame_list(frames.numbers[dark])} are nearly black: no pixel reaches {DARKEST_PEAK} of 255"
    if bright:
        listed = frame_list(frames.numbers[bright])
        yield f"frames {listed} are saturated: over {SATURATED_SHARE:.0%} of the pixels are 255"


def _cuts(frames: _Frames, jumps: set[int]) -> Iterator[str]:
    """Pictures that change at once where the probe hardly moves: another depth, gain or mode."""
    if len(frames.numbers) < LEAST_PICTURES:
        return
    changes, past_one = (frames.changes(slice(-reach), slice(reach, None)) for reach in (1, 2))
    usual_mm = usual_step(frames.steps_mm)
    is_moving = frames.steps_mm > REST * usual_mm
    usual = float(np.median(changes[is_moving] if is_moving.any() else changes))
    # Pictures of a smooth body change by the square of a step.
    by_step = usual * np.maximum(frames.steps_mm / max(usual_mm, 1e-9), 1.0) ** 2
    for place in np.flatnonzero(changes > np.maximum(CUT_FACTOR * by_step, SMALLEST_CUT)):
        is_single = place > 0 and past_one[place - 1] < changes[place] / 2
        is_slow = frames.steps_mm[place] <= 2 * usual_mm
        if place not in jumps and is_slow and not is_single:
            yield (
                f"the picture changes at once from frame {frames.numbers[place]} to {frames.numbers[place + 1]}, "
                f"{changes[place] / max(usual, 1e-6):.0f} times as much as usual, where the probe hardly moves: were "
                "frames lost, or was the depth or another setting changed?"
            )


def _overlays(frames: _Frames) -> Iterator[str]:
    """Bright pixels that never change while others do: text, rulers and logos of the scanner."""
    boxes = overlay_boxes(frames.images(), len(frames.numbers))
    if boxes:
        left, top = (frames.region.left, frames.region.top) if frames.region else (0, 0)
        is_fan = isinstance(frames.probe, Fan)
        places = "; ".join(
            f"columns {left + box.left}:{left + box.right}, rows {top + box.top}:{top + box.bottom}"
            for box in boxes[:MAX_BOXES]
        )
        yield (
            f"bright pixels never change at {places}{' of the scan lines' if is_fan else ''}: text or a ruler burnt "
            "in, perhaps a name? Crop it away"
        )


def overlay_boxes(images: Iterable[np.ndarray], count: int) -> list[CropBox]:
    """Where images show the same bright marks while the rest of them changes, the largest first."""
    boxes = []
    for mark in burnt_in(images, count):
        rows, columns = (places + first for places, first in zip(np.nonzero(mark.pixels), mark[:2], strict=True))
        if len(rows) >= LEAST_MARKS:
            boxes.append(CropBox(int(columns.min()), int(columns.max()) + 1, int(rows.min()), int(rows.max()) + 1))
    return boxes


def without_names(dataset: Dataset) -> tuple[Dataset, int]:
    """The dataset without what may name a person: its name, and marks burnt into its pixels, which become black.

    And how many marks there were. What is dim, changes, or lies in fewer than eight frames is not found.
    """
    given, parts = (dataset.train, dataset.val), []
    boxes = overlay_boxes((image for part in given for image in part.images), sum(map(len, given)))
    for part in given:
        images = part.images.copy() if boxes else part.images
        for box in boxes:
            top, left = max(0, box.top - MARGIN), max(0, box.left - MARGIN)
            images[:, top : box.bottom + MARGIN, left : box.right + MARGIN] = 0
        parts.append(replace(part, images=images))
    return Dataset("anonymous", *parts), len(boxes)


def _dataset_warnings(dataset: Dataset, path: PathReport | None) -> list[str]:
    found = [
        *dict.fromkeys((*dataset.train.notes, *dataset.val.notes)),
        *(list(dataset.probe.oddities()) or _hardly_moved(dataset.train)),
        *(() if path is None else path.warnings),
    ]
    known = set(_contents(dataset.train))
    leaked = [place for place, frame in enumerate(_contents(dataset.val)) if frame in known]
    if leaked:
        listed = frame_list(dataset.val.frame_numbers[leaked])
        found.append(f"held-out frames {listed} are also training frames: metrics will flatter")
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
    return [
        f"{found}, where scan lines are {sweep.probe.scan_line_length_mm:.0f} mm long: positions in "
        "centimetres or metres?"
    ]


def _contents(sweep: Sweep) -> list[tuple[bytes, bytes]]:
    return [(_digest(image), _digest(pose)) for image, pose in zip(sweep.images, sweep.poses, strict=True)]
