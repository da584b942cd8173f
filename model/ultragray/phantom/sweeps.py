"""The phantom's sweeps: freehand along the spine, straight and tilted, and one held out at another tilt."""

from __future__ import annotations

import numpy as np

from ultragray.errors import InvalidArgument
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import FloatArray, LinearProbe
from ultragray.learn.sweep import Dataset, Sweep
from ultragray.phantom.imaging import simulate

PHANTOM_PROBE = LinearProbe(width_mm=60.0, near_mm=0.0, far_mm=60.0)
PHANTOM_IMAGE_SIDE = 256
SWEEP_MM = 72.0


def freehand_poses(
    count: int, *, tilt_deg: float = 0.0, offset_mm: float = 0.0, unrest: float = 0.0
) -> FloatArray:  # [C, 4, 4] mm
    """A freehand sweep of `count` frames along the spine, y from −36 to 36 mm, about a tilt in elevation.

    `offset_mm` moves it to the patient's right, `unrest` is the phase in which the hand sways. The middle frame of an
    odd count is the identity where nothing else is asked for. Raises InvalidArgument for a negative count.
    """
    if count < 0:
        raise InvalidArgument(f"count must be at least 0, got {count}", field="count")
    u = np.linspace(-1.0, 1.0, count) if count > 1 else np.zeros(count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    swings_deg = (  # about x, y, z
        tilt_deg + 4.0 * np.sin(5.0 * u + unrest),
        3.0 * np.sin(7.0 * u + unrest),
        2.0 * np.sin(3.0 * u + unrest),
    )
    about_x, about_y, about_z = (_rotations(axis, np.radians(swing)) for axis, swing in enumerate(swings_deg))
    poses[:, :3, :3] = about_x @ about_y @ about_z
    poses[:, 0, 3] = offset_mm + 1.5 * np.sin(4.0 * u + unrest)
    poses[:, 1, 3] = SWEEP_MM / 2 * u
    return check_poses(poses, field="poses")


def _rotations(axis: int, angle_rad: FloatArray) -> FloatArray:  # [C] -> [C, 3, 3]
    i, j = (axis + 1) % 3, (axis + 2) % 3
    rotations = np.tile(np.eye(3), (len(angle_rad), 1, 1))
    rotations[:, i, i] = rotations[:, j, j] = np.cos(angle_rad)
    rotations[:, j, i] = np.sin(angle_rad)
    rotations[:, i, j] = -rotations[:, j, i]
    return rotations


def phantom_poses() -> tuple[FloatArray, FloatArray]:  # [T, 4, 4], [V, 4, 4] mm
    """Those that the dataset `phantom` is trained from, and those that it holds out.

    A straight sweep and two tilted by ±9° and 3 mm to the sides to train from; held out, a sweep tilted by 5°.
    """
    train = [
        freehand_poses(91),
        freehand_poses(60, tilt_deg=9.0, offset_mm=3.0, unrest=1.0),
        freehand_poses(60, tilt_deg=-9.0, offset_mm=-3.0, unrest=2.0),
    ]
    return np.concatenate(train), freehand_poses(24, tilt_deg=5.0, offset_mm=1.0, unrest=3.0)


def scan_phantom(poses: FloatArray, first: int = 0) -> Sweep:
    """The frames of the dataset `phantom` from poses [F, 4, 4], mm, numbered from `first`."""
    images = simulate(poses, probe=PHANTOM_PROBE, height=PHANTOM_IMAGE_SIDE, width=PHANTOM_IMAGE_SIDE)
    return Sweep(images, poses, PHANTOM_PROBE, np.arange(first, first + len(poses)), "phantom")


def load_phantom() -> Dataset:
    """The dataset `phantom`, the same on every call, in about half a minute."""
    train, val = phantom_poses()
    return Dataset("phantom", train=scan_phantom(train), val=scan_phantom(val, first=len(train)))
