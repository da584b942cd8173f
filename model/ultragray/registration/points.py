"""register_points(): the rigid transform between points that are known in two frames, by least squares.

Kabsch (1976): with the points centred, H = Σ p qᵀ = U S Vᵀ, R = V diag(1, 1, det(V Uᵀ)) Uᵀ and t = q̄ − R p̄.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ultragray.errors import InvalidArgument
from ultragray.probe import FloatArray

LEAST_POINTS = 3
LEAST_SPREAD = 1e-3  # of the longest extent of the points, across it: less is a line
MIRRORED = 0.5  # of the residuals: a reflection that halves them is what the points show


@dataclass(frozen=True, eq=False)
class PointFit:
    """A transform of points onto targets, and how well it fits.

    The standard deviations are of the place of the middle of the targets, and of turns about the axes of their frame
    through it. They follow from the residuals, of which three points leave few.
    """

    transform: FloatArray  # [4, 4] mm
    residuals_mm: FloatArray  # [N]
    position_std_mm: tuple[float, float, float]
    angle_std_deg: tuple[float, float, float]

    @property
    def rms_mm(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt(np.square(self.residuals_mm).mean()))


def register_points(points: Any, targets: Any) -> PointFit:  # [N, 3] mm both
    """The rigid transform that takes points onto targets with the least squared distance.

    Raises InvalidArgument for fewer than three, for other counts of targets, for points on a line or in one place, and
    for targets that are the points' mirror image, as where one of the frames is left-handed.
    """
    points, targets = _checked(points, "points"), _checked(targets, "targets")
    if len(points) != len(targets):
        raise InvalidArgument(f"each point needs its target: got {len(points)} and {len(targets)}", field="targets")
    for name, given in (("points", points), ("targets", targets)):
        _require_a_plane(given, name)
    middle, target_middle = points.mean(axis=0), targets.mean(axis=0)
    rotation = _rotation(points - middle, targets - target_middle)
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = target_middle - rotation @ middle
    centred = (points - middle) @ rotation.T
    left = centred - (targets - target_middle)
    position_std_mm, angle_std_deg = _deviations(centred, left)
    return PointFit(transform, np.linalg.norm(left, axis=1), position_std_mm, angle_std_deg)


def _rotation(points: FloatArray, targets: FloatArray) -> FloatArray:  # [N, 3] centred -> [3, 3]
    """Raises InvalidArgument for mirrored targets."""
    left, strengths, right = np.linalg.svd(points.T @ targets)
    sign = np.sign(np.linalg.det(right.T @ left.T))
    all_squares = np.square(points).sum() + np.square(targets).sum()
    mirrored = max(0.0, all_squares - 2.0 * strengths.sum())
    proper = max(0.0, all_squares - 2.0 * (strengths[0] + strengths[1] + sign * strengths[2]))
    if sign < 0 and mirrored < MIRRORED**2 * proper:
        raise InvalidArgument(
            "targets are the mirror image of points: one of the two frames is left-handed, or has two axes exchanged",
            field="targets",
        )
    rotation: FloatArray = right.T @ np.diag([1.0, 1.0, sign]) @ left.T
    return rotation


def _deviations(
    centred: FloatArray,  # [N, 3] as they lie in the targets' frame
    left: FloatArray,  # [N, 3]
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Standard deviations of the middle, mm, and of turns about it, degrees: of 3N residuals and six unknowns."""
    variance = float(np.square(left).sum()) / (left.size - 6)
    spread = np.square(centred).sum() * np.eye(3) - centred.T @ centred
    turns = np.degrees(np.sqrt(variance * np.diag(np.linalg.inv(spread))))
    position = float(np.sqrt(variance / len(left)))
    return (position, position, position), (float(turns[0]), float(turns[1]), float(turns[2]))


def _checked(values: Any, field: str) -> FloatArray:  # [N, 3]
    try:
        array = np.asarray(values, np.float64)
    except (TypeError, ValueError):
        raise InvalidArgument(f"{field} must be numbers [N, 3]", field=field) from None
    if array.ndim != 2 or array.shape[1] != 3:
        raise InvalidArgument(f"{field} must be numbers [N, 3], got {list(array.shape)}", field=field)
    if len(array) < LEAST_POINTS:
        raise InvalidArgument(f"{field} must be {LEAST_POINTS} or more, got {len(array)}", field=field)
    if not np.isfinite(array).all():
        raise InvalidArgument(f"{field} must be finite, got NaN or infinity", field=field)
    return array


def _require_a_plane(points: FloatArray, field: str) -> None:
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if extents[1] <= LEAST_SPREAD * extents[0] or extents[0] == 0.0:
        raise InvalidArgument(
            f"{field} lie on a line, or in one place: a turn about it stays unknown; add one beside it", field=field
        )
