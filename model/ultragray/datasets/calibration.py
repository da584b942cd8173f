"""From the transforms of a tracked image to poses of a linear probe: docs/physics.md §1.

The image's calibration gives the directions of its columns and rows and their sizes in mm, which need not be square nor
exactly at a right angle.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ultragray.datasets.images import CropBox
from ultragray.datasets.region import ImageRegion
from ultragray.datasets.sweep import IntArray
from ultragray.errors import DatasetInvalid
from ultragray.probe import FloatArray, LinearProbe

SCALE_TOLERANCE = 1e-3  # relative; trackers write six digits
SMALLEST_ANGLE_DEG = 45.0


def poses_from_image_transforms(
    transforms: FloatArray, crop: CropBox, frame_numbers: IntArray, path: Path
) -> tuple[FloatArray, LinearProbe]:  # [F, 4, 4] pixels → tracker, mm
    """Poses [F, 4, 4] whose origin is the top centre of the crop, and the probe that spans the crop.

    The lateral axis x keeps the direction of the image's columns; the depth axis z is that of its rows made
    orthogonal to x (Gram–Schmidt); y = z × x, so that a calibration of either handedness gives a proper pose: the
    image's third axis is not used. Sizes are the lengths of the two columns in mm per pixel. Pixel (u, v) lies at
    integer coordinates, its edges half a pixel away. Raises DatasetInvalid, naming the frame, where the axes of the
    image are no plane or its scale changes.
    """
    columns, rows = transforms[:, :3, 0], transforms[:, :3, 1]
    scales = np.stack([np.linalg.norm(columns, axis=1), np.linalg.norm(rows, axis=1)], axis=1)  # [F, 2] mm
    usual = np.median(scales, axis=0)
    cosines = np.abs((columns * rows).sum(axis=1)) / scales.prod(axis=1)
    for number, scale, cosine in zip(frame_numbers, scales, cosines, strict=True):
        if np.abs(scale / usual - 1.0).max() > SCALE_TOLERANCE:
            raise DatasetInvalid(
                f"{path}: frame {number}: a pixel is {scale[0]:.5g} x {scale[1]:.5g} mm, in other frames "
                f"{usual[0]:.5g} x {usual[1]:.5g}"
            )
        if not cosine < np.cos(np.radians(SMALLEST_ANGLE_DEG)):
            raise DatasetInvalid(f"{path}: frame {number}: columns and rows of the image are nearly parallel")
    x = columns / scales[:, :1]
    z = rows - (rows * x).sum(axis=1, keepdims=True) * x
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (len(transforms), 1, 1))
    poses[:, :3, 0], poses[:, :3, 1], poses[:, :3, 2] = x, np.cross(z, x), z
    top_centre = np.array([(crop.left + crop.right - 1) / 2, crop.top - 0.5, 0.0, 1.0])
    poses[:, :3, 3] = (transforms @ top_centre)[:, :3]
    width_mm, depth_mm = (round(float(size), 9) for size in usual * (crop.width, crop.height))
    return poses, LinearProbe(width_mm=width_mm, near_mm=0.0, far_mm=depth_mm)


def pixel_size_mm(transforms: FloatArray) -> tuple[float, float]:  # [F, 4, 4] pixels → mm
    """Lateral and axial size of a pixel."""
    lateral_mm, axial_mm = np.median(np.linalg.norm(transforms[:, :3, :2], axis=1), axis=0).tolist()
    return lateral_mm, axial_mm


def region_of(
    size: tuple[int, ...],
    box: CropBox,
    pixel_mm: tuple[float, float],  # lateral, axial
    calibration: FloatArray | None,  # [4, 4]
) -> ImageRegion:
    """The region of a crop in images of (rows, columns)."""
    return ImageRegion(
        image_width=size[1],
        image_height=size[0],
        left=box.left,
        top=box.top,
        width=box.width,
        height=box.height,
        lateral_mm=pixel_mm[0],
        axial_mm=pixel_mm[1],
        image_to_probe=() if calibration is None else tuple(calibration.ravel().tolist()),
    )
