"""Sweeps: tracked frames with their poses and their probe, the part of an image that holds ultrasound, and the split
into training and held-out frames. Every data set format ends here, every training begins here.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from ultragray.contract import Contract, described, to_dict
from ultragray.errors import DatasetInvalid, InvalidArgument, InvalidPose
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.geometry.rotations import rotation_angles_deg


@dataclass(frozen=True)
class ImageRegion(Contract):
    """Where the frames of a sequence lie in its images, brought to columns lateral and rows in depth."""

    image_width: int = described("Of the stored image, pixels.", low=1)
    image_height: int = described("Of the stored image, pixels.", low=1)
    left: int = described("Column of the stored image at which the frames begin.", low=0)
    top: int = described("Row at which they begin.", low=0)
    width: int = described("Of the frames in the stored image, pixels, before they are resized.", low=1)
    height: int = described("Likewise.", low=1)
    lateral_mm: float = described("Distance of two columns of the stored image.", above=0.0)
    axial_mm: float = described("Distance of two rows of the stored image.", above=0.0)
    image_to_probe: tuple[float, ...] = described(
        "The calibration, from pixels (column, row, 0) of the stored image to the probe's mm: 16 numbers row by row; "
        "empty where the file has none of that name.",
        (),
    )


@dataclass(frozen=True)
class Link:
    """A transform on the way from pixels to the frame that the poses are in, as it was used."""

    origin: str
    target: str
    transform: str  # its name where it comes from, such as ImageToProbe
    source: str  # where it comes from
    is_inverted: bool = False
    is_tracked: bool = False  # another one in every frame

    def __str__(self) -> str:
        kind = "tracked" if self.is_tracked else "fixed"
        inverse = "the inverse of " if self.is_inverted else ""
        return f"{self.origin} → {self.target}: {inverse}{self.transform} of {self.source}, {kind}"


@dataclass(frozen=True)
class Chain:
    """All that a recording says about the way from pixels to the frame of the poses."""

    links: tuple[Link, ...] = ()
    left_out: tuple[str, ...] = ()  # transforms that are no part of it, and where they are from


# Sweep and Dataset: tracked B-mode frames, checked once and trusted afterwards.
#
# Convention. Images are uint8 [F, H, W], rows of equal thickness between the probe's near and far (docs/physics.md
# §3); poses are rigid probe→tracker transforms [F, 4, 4] in mm. A scene trained from a dataset answers poses in that
# frame.

ByteArray: TypeAlias = npt.NDArray[np.uint8]
IntArray: TypeAlias = npt.NDArray[np.int64]


def check_frame_poses(poses: FloatArray, frame_numbers: IntArray, source: str) -> FloatArray:  # [F, 4, 4]
    """The poses, mm, with exact rotations (`check_poses`).

    Raises DatasetInvalid, naming the source and the frame, for a pose that is not rigid.
    """
    if poses.shape[1:] != (4, 4):
        raise DatasetInvalid(f"{source}: poses must be [F, 4, 4], got {list(poses.shape)}")
    try:
        return check_poses(poses)
    except InvalidPose:
        for number, pose in zip(frame_numbers, poses, strict=True):
            try:
                check_poses(pose, field="its pose")
            except InvalidPose as error:
                raise DatasetInvalid(f"{source}: frame {number}: {error}") from error
        raise


@dataclass(frozen=True, eq=False)
class Sweep:
    """F frames of one probe. `source` says where they come from, as messages name it.

    Raises DatasetInvalid, naming the source, the frame and the reason, for images that are not uint8 [F, H, W], counts
    that differ, poses that are not rigid, and frames in which every pixel is the same.
    """

    images: ByteArray  # [F, H, W]
    poses: FloatArray  # [F, 4, 4] mm, probe→tracker
    probe: Probe
    frame_numbers: IntArray  # [F] of each frame in its source
    source: str
    notes: tuple[str, ...] = ()  # what reading it left out or assumed, for a person
    region: ImageRegion | None = None  # of the stored images; None: the images are stored as they are
    chain: Chain = Chain()
    times_s: FloatArray | None = None  # [F] of the images, in the order of the frames

    def __repr__(self) -> str:
        frames = f"{len(self.images):,} frames of {self.images.shape[1]}x{self.images.shape[2]}"
        return f"Sweep({frames}, {self.probe}, {self.source!r})"

    def __post_init__(self) -> None:
        images, count = self.images, len(self.images)
        if images.dtype != np.uint8 or images.ndim != 3 or 0 in images.shape[1:]:
            raise DatasetInvalid(
                f"{self.source}: images must be uint8 [F, H, W], got {images.dtype} {list(images.shape)}"
            )
        if len(self.poses) != count or len(self.frame_numbers) != count:
            raise DatasetInvalid(f"{self.source}: it holds {count} images but {len(self.poses)} poses")
        object.__setattr__(self, "poses", check_frame_poses(self.poses, self.frame_numbers, self.source))
        for number, image in zip(self.frame_numbers, images, strict=True):
            if image.min() == image.max():
                raise DatasetInvalid(
                    f"{self.source}: frame {number} is constant: every pixel is {image.min()}; leave it out"
                )

    @classmethod
    def of_recording(
        cls,
        images: ByteArray,  # [F, H, W]
        poses: FloatArray,  # [F, 4, 4] mm, probe→tracker
        probe: Probe,
        frame_numbers: IntArray,  # [F]
        source: str,
        notes: tuple[str, ...] = (),
        *,
        times_s: FloatArray | None = None,  # [F]
        region: ImageRegion | None = None,
        chain: Chain = Chain(),
    ) -> Sweep:
        """The sweep without the frames in which every pixel is the same, as of a probe that was lifted off.

        Its notes say which. Raises DatasetInvalid where these are all frames, and as Sweep does.
        """
        has_image = np.array([not image.size or image.min() < image.max() for image in images], bool)
        if len(images) and not has_image.any():
            raise DatasetInvalid(f"{source}: in each frame every pixel is the same: {frame_list(frame_numbers)}")
        if not has_image.all():
            lost = frame_numbers[~has_image]
            listed = f"{frame_list(lost)} ({len(lost)} in all)"
            notes += (f"frames in which every pixel is the same were left out: {listed}",)
            images, poses, frame_numbers = images[has_image], poses[has_image], frame_numbers[has_image]
            times_s = None if times_s is None else times_s[has_image]
        return cls(images, poses, probe, frame_numbers, source, notes, region, chain, times_s)

    def __len__(self) -> int:
        return len(self.images)

    @property
    def height(self) -> int:
        return int(self.images.shape[1])

    @property
    def width(self) -> int:
        return int(self.images.shape[2])

    @property
    def pixel_mm(self) -> tuple[float, float]:
        """Axial and lateral size of a pixel at the middle of the image, mm."""
        axial = self.probe.scan_line_length_mm / self.height
        origins, directions = self.probe.scan_lines(2 * self.width)
        middle = self.width
        depth = 0.5 * (self.probe.near_mm + self.probe.far_mm)
        points = origins[middle - 1 : middle + 1] + depth * directions[middle - 1 : middle + 1]
        return axial, 2.0 * float(np.linalg.norm(points[1] - points[0]))

    def select(self, places: npt.ArrayLike) -> Sweep:
        """The frames at these places (not frame numbers) of this sweep."""
        chosen = np.asarray(places, dtype=np.int64)
        return replace(
            self,
            images=self.images[chosen],
            poses=self.poses[chosen],
            frame_numbers=self.frame_numbers[chosen],
            times_s=None if self.times_s is None else self.times_s[chosen],
        )

    def corners_mm(self) -> FloatArray:  # [F, 4 or 6, 3]
        """Corners of each image plane in the tracker's frame."""
        return self.probe.corners_from(self.poses)


def frame_list(numbers: Iterable[int]) -> str:
    """Frame numbers in words, at most ten of them: `1, 3, 5`; of more than ten those that follow each other as one."""
    ranges = [(number, number) for number in map(int, numbers)]
    if len(ranges) > 10:
        for place in range(len(ranges) - 1, 0, -1):
            if ranges[place - 1][1] + 1 == ranges[place][0]:
                ranges[place - 1 : place + 1] = [(ranges[place - 1][0], ranges[place][1])]
    words = [str(a) if a == b else f"{a} to {b}" for a, b in ranges[:10]]
    return ", ".join(words) + (", …" if len(ranges) > 10 else "")


def spread_places(count: int, most: int) -> IntArray:
    """At most `most` of the places 0 … count − 1, evenly spread."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.int64)


def corner_distances_mm(corners: FloatArray, others: FloatArray) -> FloatArray:  # [..., K, 3] both -> [...]
    """Distances between image planes: the mean over corresponding corners, mm; shapes broadcast."""
    means: FloatArray = np.linalg.norm(corners - others, axis=-1).mean(axis=-1)
    return means


REST = 0.2  # of a long step: shorter ones are those of a probe held still, or poses that a tracker repeats


def usual_step(steps: FloatArray) -> float:
    """The median step of a path while the probe moves, whether or not it rests or its poses repeat; 0: it never moves.

    Up to a quarter of the steps may be jumps, and three quarters those of a probe at rest.
    """
    moves = steps[steps > REST * np.quantile(steps, 0.75)] if len(steps) else steps
    return float(np.median(moves)) if len(moves) else 0.0


def pixel_positions_mm(probe: Probe, height: int, width: int) -> FloatArray:  # [H·W, 3], row by row
    origins, directions = probe.scan_lines(width)
    positions: FloatArray = origins + probe.depths_mm(height)[:, None, None] * directions
    return positions.reshape(-1, 3)


def nearest_frames(sweep: Sweep, poses: FloatArray) -> IntArray:  # [C]
    """The place of the sweep's frame whose corners lie nearest on average, for each pose [C, 4, 4] (mm)."""
    corners = sweep.corners_mm()
    pose_corners = sweep.probe.corners_from(poses)
    return np.array([corner_distances_mm(corners, own).argmin() for own in pose_corners], np.int64)


ON_PATH = 0.5  # of the usual step from frame to frame: as far beside the path between two frames lies one of its own
IN_ORDER = 0.8  # of such frames lie beyond the one before
LONGEST_STEP = 6.0  # usual steps: a longer one leads from one sweep to another


def _along_path(sweep: Sweep, others: Sweep) -> FloatArray | None:  # [V]
    """Where other frames lie on the path of a sweep: the place of the frame before, and the share of the step from it.

    In their own order, which poses that shake may contradict. None where they do not lie on it, or not in their order.
    """
    starts, ends = sweep.corners_mm()[:-1], sweep.corners_mm()[1:]  # [F − 1, K, 3]
    steps, lengths = ends - starts, corner_distances_mm(ends, starts)
    usual_mm = usual_step(lengths)
    if not len(others) or usual_mm == 0.0:
        return None
    squares = np.square(steps).sum(axis=(1, 2))
    places, beside_mm = np.empty((2, len(others)))
    for place, own in enumerate(others.corners_mm()):
        ways = own - starts
        shares = np.clip((ways * steps).sum(axis=(1, 2)) / np.maximum(squares, 1e-12), 0.0, 1.0)
        distances = corner_distances_mm(starts + shares[:, None, None] * steps, own)
        distances[lengths > LONGEST_STEP * usual_mm] = np.inf
        nearest = int(distances.argmin())
        places[place], beside_mm[place] = nearest + shares[nearest], distances[nearest]
    back = np.count_nonzero(np.diff(places) < 0.0)
    is_on = np.median(beside_mm) < ON_PATH * usual_mm and back <= (1.0 - IN_ORDER) * len(others)
    return np.sort(places) if is_on else None


@dataclass(frozen=True, eq=False)
class Dataset:
    """Frames to train from and frames held out to measure with (there may be none), of one probe and image size.

    Raises DatasetInvalid where there are fewer than two training frames, or the two parts disagree.
    """

    name: str
    train: Sweep
    val: Sweep

    def __post_init__(self) -> None:
        if len(self.train) < 2:
            raise DatasetInvalid(
                f"{self.train.source}: a scene needs at least two training frames, got {len(self.train)}"
            )
        sizes = [part.images.shape[1:] for part in (self.train, self.val)]
        if len(self.val) and (sizes[0] != sizes[1] or self.train.probe != self.val.probe):
            raise DatasetInvalid(
                f"{self.name}: training frames are {list(sizes[0])} of {self.train.probe}, held-out frames "
                f"{list(sizes[1])} of {self.val.probe}"
            )

    @property
    def probe(self) -> Probe:
        return self.train.probe

    @property
    def is_one_recording(self) -> bool:
        """Whether both parts are frames of one recording, in the order of their numbers."""
        return self.train.source == self.val.source and not set(self.train.frame_numbers) & set(self.val.frame_numbers)

    @cached_property
    def places(self) -> IntArray | None:  # [F + V]
        """The place of each frame, training frames first, in the recording that both parts are of.

        By the numbers of the frames, if these are of one source. Frames of another file are taken to be of the same
        recording if they lie on the path between the training frames, in their order. None: they do not.
        """
        if self.is_one_recording:
            numbers = np.concatenate([self.train.frame_numbers, self.val.frame_numbers]).astype(np.float64)
        elif (along := _along_path(self.train, self.val)) is not None:
            numbers = np.concatenate([np.arange(len(self.train)), along])
        else:
            return None
        return np.argsort(np.argsort(numbers, kind="stable"), kind="stable")

    @property
    def centre_mm(self) -> FloatArray:  # [3]
        """Origin of the scene: the mean of the corners of the training frames (docs/physics.md §6)."""
        mean: FloatArray = self.train.corners_mm().mean(axis=(0, 1))
        return mean

    @property
    def sha256(self) -> str:
        """A hash of images, poses, probe and split, however they are stored."""
        digest = hashlib.sha256(json.dumps(to_dict(self.probe), sort_keys=True).encode())
        for part in (self.train, self.val):
            digest.update(repr(part.images.shape).encode())
            digest.update(np.ascontiguousarray(part.images).reshape(-1).data)
            digest.update(np.ascontiguousarray(part.poses).reshape(-1).data)
        return digest.hexdigest()


@dataclass(frozen=True, eq=False)
class Distances:
    """How far each held-out frame is from the nearest training view, by the mean distance of their corners."""

    mm: FloatArray  # [F]
    deg: FloatArray  # [F] between the orientations of the same two frames

    @classmethod
    def of(cls, dataset: Dataset) -> Distances:
        nearest = nearest_frames(dataset.train, dataset.val.poses)
        places = np.arange(len(nearest))
        corners = dataset.train.corners_mm()[nearest]
        turned = rotation_angles_deg(dataset.val.poses, dataset.train.poses)[places, nearest]
        return cls(np.linalg.norm(dataset.val.corners_mm() - corners, axis=-1).mean(axis=1), turned)


# The split of a sweep into frames to train from and frames held out.
#
# Ranges of frames are what a user writes: `0:90`, `0:90,100:120:2`, `7`, `:50`, `150:`.

HELD_OUT_START, HELD_OUT_STEP = 2, 5  # of a single sequence: every fifth frame, from the third
_PART = re.compile(r"(?P<start>\d{0,9})(?P<range>:(?P<stop>\d{0,9})(:(?P<step>\d{1,9}))?)?")


def split_parts(train: Sweep, val: Sweep, train_frames: str | None, val_frames: str | None) -> tuple[Sweep, Sweep]:
    """Training and held-out frames of a dataset that has both parts; ranges are places in its training part.

    `train_frames` alone keeps the held-out part. `val_frames` alone trains from all other frames of the training
    part, and the held-out part is not used. Raises InvalidArgument for ranges that overlap or do not exist.
    """
    chosen_train, chosen_val = _chosen(len(train), train_frames, val_frames)
    if chosen_val is None:
        return (train if chosen_train is None else train.select(chosen_train)), val
    if chosen_train is None:
        chosen_train = _others(len(train), chosen_val)
    return train.select(chosen_train), train.select(chosen_val)


def split_sequence(
    sweep: Sweep, frame_count: int, train_frames: str | None, val_frames: str | None
) -> tuple[Sweep, Sweep]:
    """Training and held-out frames of a single sequence; ranges are frame numbers 0 … frame_count − 1 of its file.

    Frames that the sweep lacks, such as those without a pose, are passed over. With one range the other part is all
    other frames; with none every fifth frame of the sweep, from the third, is held out.
    """
    chosen_train, chosen_val = _chosen(frame_count, train_frames, val_frames)
    if chosen_train is None and chosen_val is None:
        held_out = list(range(HELD_OUT_START, len(sweep), HELD_OUT_STEP))
        return sweep.select(_others(len(sweep), held_out)), sweep.select(held_out)
    if chosen_train is None:
        chosen_train = _others(frame_count, chosen_val or [])
    if chosen_val is None:
        chosen_val = _others(frame_count, chosen_train)
    place = {int(number): i for i, number in enumerate(sweep.frame_numbers)}
    train, val = ([place[number] for number in part if number in place] for part in (chosen_train, chosen_val))
    return sweep.select(train), sweep.select(val)


def in_recorded_order(dataset: Dataset) -> tuple[ByteArray, FloatArray]:  # [F, H, W], [F, 4, 4] mm
    """The frames that a data set was recorded as; of one that is split otherwise those to train from."""
    train, val = dataset.train, dataset.val
    held_out = np.arange(HELD_OUT_START, len(train) + len(val), HELD_OUT_STEP)
    if len(held_out) != len(val):
        return train.images, train.poses
    others = np.setdiff1d(np.arange(len(train) + len(val)), held_out)
    order = np.argsort(np.concatenate([others, held_out]))
    return np.concatenate([train.images, val.images])[order], np.concatenate([train.poses, val.poses])[order]


def _chosen(count: int, train_frames: str | None, val_frames: str | None) -> tuple[list[int] | None, list[int] | None]:
    train, val = (
        None if text is None else parse_frame_ranges(text, count, option=option)
        for text, option in ((train_frames, "train_frames"), (val_frames, "val_frames"))
    )
    shared = sorted(set(train or ()) & set(val or ()))
    if shared:
        raise InvalidArgument(
            f"train_frames and val_frames share {len(shared)} frames, the first is {shared[0]}: a frame that was "
            "trained from cannot be held out",
            field="val_frames",
        )
    return train, val


def _others(count: int, chosen: list[int]) -> list[int]:
    taken = set(chosen)
    return [i for i in range(count) if i not in taken]


def parse_frame_ranges(text: str, count: int, *, option: str) -> list[int]:
    """The frames that `text` names among `count` of them, ascending, each once.

    Parts are separated by commas: a single frame, or start:stop:step with stop left out, as in Python; start, stop and
    step may be missing. Raises InvalidArgument, naming the option, for anything else, for frames that do not exist and
    for a range without frames.
    """
    chosen: set[int] = set()
    for part in text.split(","):
        match = _PART.fullmatch(part.strip())
        if match is None or not part.strip():
            raise InvalidArgument(
                f"{option} must be frames such as 7, 0:90 or 0:90,100:120:2 (the stop is left out), got {text[:80]!r}",
                field=option,
            )
        start, stop, step = int(match["start"] or 0), int(match["stop"] or count), int(match["step"] or 1)
        if match["range"] is None:
            stop = start + 1
        frames = range(start, stop, step) if step else range(0)
        if not len(frames):
            raise InvalidArgument(f"{option}: {part.strip()!r} names no frame", field=option)
        if frames[-1] >= count:
            raise InvalidArgument(
                f"{option}: {part.strip()!r} goes up to frame {frames[-1]}, but there are only {count}, counted from 0",
                field=option,
            )
        chosen.update(frames)
    return sorted(chosen)
