"""Sweep and Dataset: tracked B-mode frames, checked once and trusted afterwards.

Convention. Images are uint8 [F, H, W], rows of equal thickness between the probe's near and far (docs/physics.md §3);
poses are rigid probe→tracker transforms [F, 4, 4] in mm. A scene trained from a dataset answers poses in that frame.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from ultragray.contract import to_dict
from ultragray.datasets.region import ImageRegion
from ultragray.errors import DatasetInvalid, InvalidPose
from ultragray.pose import check_poses
from ultragray.probe import FloatArray, Probe

ByteArray: TypeAlias = npt.NDArray[np.uint8]
IntArray: TypeAlias = npt.NDArray[np.int64]


def check_frame_poses(poses: FloatArray, frame_numbers: IntArray, source: str) -> FloatArray:  # [F, 4, 4]
    """The poses, mm, with exact rotations (`check_poses`).

    Raises DatasetInvalid, naming the source and the frame, for a pose that is not rigid.
    """
    if poses.shape[1:] != (4, 4):
        raise DatasetInvalid(f"{source}: poses must be [F, 4, 4], got {list(poses.shape)}")
    try:
        return check_poses(poses) if len(poses) else poses
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
            self, images=self.images[chosen], poses=self.poses[chosen], frame_numbers=self.frame_numbers[chosen]
        )

    def corners_mm(self) -> FloatArray:  # [F, 4 or 6, 3]
        """Corners of each image plane in the tracker's frame."""
        corners: FloatArray = np.einsum("fij,cj->fci", self.poses[:, :3, :3], self.probe.corners_mm())
        return corners + self.poses[:, None, :3, 3]


def spread_places(count: int, most: int) -> IntArray:
    """At most `most` of the places 0 … count − 1, evenly spread."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.int64)


def corner_distances_mm(corners: FloatArray, others: FloatArray) -> FloatArray:  # [..., K, 3] both -> [...]
    """Distances between image planes: the mean over corresponding corners, mm; shapes broadcast."""
    distances: FloatArray = np.linalg.norm(corners - others, axis=-1).mean(axis=-1)
    return distances


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
    def centre_mm(self) -> FloatArray:  # [3]
        """Origin of the scene: the mean of the corners of the training frames (docs/physics.md §6)."""
        centre: FloatArray = self.train.corners_mm().mean(axis=(0, 1))
        return centre

    @property
    def sha256(self) -> str:
        """A hash of images, poses, probe and split, however they are stored."""
        digest = hashlib.sha256(json.dumps(to_dict(self.probe), sort_keys=True).encode())
        for part in (self.train, self.val):
            digest.update(repr(part.images.shape).encode())
            digest.update(np.ascontiguousarray(part.images).reshape(-1).data)
            digest.update(np.ascontiguousarray(part.poses).reshape(-1).data)
        return digest.hexdigest()
