# Generated from ultragray.geometry.pose by client/generate.py; change that.
"""Poses: rigid probe→scene transforms, [4, 4], millimetres.

Convention. p_scene = R p_probe + t. The columns of R are the probe's lateral, elevation and axial axes in the scene's
frame. Quaternions are w, x, y, z in that order, and rotate from the probe to the scene.
Worked value: position (0, 0, 10) mm with quaternion w=1 puts the probe's origin 10 mm along the scene's z.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ultragray_client.errors import InvalidPose
from ultragray_client.geometry import FloatArray

ROTATION_TOLERANCE = 1e-3
EXACT = 1e-14
_IDENTITY = np.eye(4)
MAX_POSITION_MM = 1e6


def check_poses(poses: Any, *, field: str = "poses") -> FloatArray:  # [C, 4, 4]
    """Rigid transforms [C, 4, 4] (or one [4, 4]) as exact float64, mm.

    A rotation within 1e-3 of a proper one (largest entry of RᵀR − 1) is replaced by the nearest proper rotation.
    Raises InvalidPose, naming the pose, for anything else: wrong shape, non-finite, scaled, sheared, mirrored, a last
    row other than 0 0 0 1, or a position beyond a kilometre.
    """
    values = _as_float64(poses, field)
    array = values[None] if values.ndim == 2 else values
    if array.ndim != 3 or array.shape[1:] != (4, 4):
        raise InvalidPose(f"{field} must have shape [C, 4, 4] or [4, 4], got {list(values.shape)}", field=field)
    if len(array) == 1 and _is_exact(array[0].tolist()):
        return array.copy()
    rotations = array[:, :3, :3]
    with np.errstate(all="ignore"):  # NaN and infinity fail the comparisons and are named below
        deviations = np.abs(rotations.transpose(0, 2, 1) @ rotations - _IDENTITY[:3, :3]).max(axis=(1, 2), initial=0.0)
        rigid = (deviations <= ROTATION_TOLERANCE) & (np.linalg.det(rotations) > 0)
        rigid &= np.abs(array[:, 3] - _IDENTITY[3]).max(axis=1, initial=0.0) <= ROTATION_TOLERANCE
        rigid &= np.abs(array[:, :3, 3]).max(axis=1, initial=0.0) <= MAX_POSITION_MM
    if not rigid.all():
        first = int(np.argmin(rigid))
        name = field if values.ndim == 2 else f"{field}[{first}]"
        raise _why_not_rigid(array[first], float(deviations[first]), name)
    exact: FloatArray = array.copy()
    exact[:, 3] = _IDENTITY[3]
    rough = deviations > EXACT  # the others stay as they are: a pose that was used once comes back to the bit
    if rough.any():
        left, _, right = np.linalg.svd(rotations[rough])
        exact[rough, :3, :3] = left @ right
    return exact


def _is_exact(rows: list[list[float]]) -> bool:  # of a pose [4, 4]
    """Whether a pose is exact already, as one is that comes by here again; numpy would take 50 µs to tell."""
    (a, b, c, x), (d, e, f, y), (g, h, i, z), last = rows
    return (
        last == [0.0, 0.0, 0.0, 1.0]
        and abs(x) <= MAX_POSITION_MM
        and abs(y) <= MAX_POSITION_MM
        and abs(z) <= MAX_POSITION_MM
        and abs(a * b + d * e + g * h) <= EXACT
        and abs(a * c + d * f + g * i) <= EXACT
        and abs(b * c + e * f + h * i) <= EXACT
        and abs(a * a + d * d + g * g - 1.0) <= EXACT
        and abs(b * b + e * e + h * h - 1.0) <= EXACT
        and abs(c * c + f * f + i * i - 1.0) <= EXACT
        and a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0.0
    )


def _as_float64(value: Any, field: str) -> FloatArray:
    if hasattr(value, "detach"):  # a torch tensor, without importing torch
        value = value.detach().cpu().numpy()
    try:
        array = np.asarray(value)
    except ValueError:
        raise InvalidPose(f"{field} must be a regular array of numbers, got ragged rows", field=field) from None
    if array.dtype.kind not in "fiu":
        raise InvalidPose(f"{field} must hold real numbers, got {array.dtype}", field=field)
    return np.asarray(array, dtype=np.float64)


def _why_not_rigid(pose: FloatArray, deviation: float, field: str) -> InvalidPose:  # [4, 4]
    rotation, position = pose[:3, :3], pose[:3, 3]
    if not np.isfinite(pose).all():
        reason = "be finite, got NaN or infinity"
    elif np.abs(pose[3] - (0, 0, 0, 1)).max() > ROTATION_TOLERANCE:
        reason = f"end in the row 0 0 0 1, got {_numbers(pose[3])}"
    elif np.abs(position).max() > MAX_POSITION_MM:
        reason = f"lie within {MAX_POSITION_MM:g} mm, got {_numbers(position)}"
    elif deviation > ROTATION_TOLERANCE:
        reason = (
            f"hold a rotation: the largest entry of RᵀR − 1 must be at most {ROTATION_TOLERANCE:g}, got "
            f"{deviation:.3g} (axis lengths {_numbers(np.linalg.norm(rotation, axis=0))})"
        )
    else:
        reason = "hold a rotation with determinant +1, got a mirrored one (−1)"
    return InvalidPose(f"{field} must {reason}", field=field)


def _numbers(values: Any) -> str:
    return "[" + ", ".join(f"{v:.6g}" for v in values) + "]"


def pose_from_position_quaternion(
    position_mm: tuple[float, float, float],  # x, y, z
    quaternion: tuple[float, float, float, float],  # w, x, y, z
    *,
    field: str = "pose",
) -> FloatArray:  # [4, 4]
    """The pose of a position in mm and a unit quaternion w, x, y, z.

    A norm within 1e-3 of 1 is made exact. Raises InvalidPose for any other norm and for non-finite values.
    """
    w, x, y, z = (float(v) for v in quaternion)
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if not abs(norm - 1.0) <= ROTATION_TOLERANCE:
        raise InvalidPose(
            f"{field}.quaternion must have norm 1 within {ROTATION_TOLERANCE:g}, got norm {norm:.6g}",
            field=f"{field}.quaternion",
        )
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = position_mm
    checked: FloatArray = check_poses(pose, field=field)[0]
    return checked


def quaternion_from_pose(pose: FloatArray) -> tuple[float, float, float, float]:
    """Unit quaternion (w, x, y, z), w >= 0, of a pose [4, 4]."""
    r = pose[:3, :3]
    trace = float(np.trace(r))
    four_squares = np.array([1 + trace, *(1 + 2 * r[k, k] - trace for k in range(3))])  # 4w², 4x², 4y², 4z²
    largest = int(np.argmax(four_squares))
    products = np.array(  # 4·q_a·q_b for the largest component a
        [
            [four_squares[0], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], four_squares[1], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
            [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], four_squares[2], r[1, 2] + r[2, 1]],
            [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], four_squares[3]],
        ]
    )[largest]
    q = products / np.linalg.norm(products)
    w, x, y, z = (float(v) for v in (q if q[0] >= 0 else -q))
    return w, x, y, z
