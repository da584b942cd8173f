"""Registration from poses of the probe that are known in the robot's frame and in the scene's.

Convention. probe→scene = base→scene · flange→base · probe→flange, all [4, 4], mm. For a tracked probe the base is the
tracker, and the flange the marker on the probe.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ultragray.errors import InvalidArgument
from ultragray.pose import check_poses
from ultragray.probe import FloatArray
from ultragray.registration.points import register_points

LEVER_MM = 50.0  # at which a turn weighs as a shift: about half the depth of an image
LEAST_POSES = 3  # where the mounting is unknown, too
LEAST_TURN_DEG = 5.0  # of the probe, about two axes, where the mounting is unknown
MOST_POSES = 200  # whose pairs are all used

_ARMS = np.concatenate([np.zeros((1, 3)), LEVER_MM * np.eye(3)])  # [4, 3]: a pose as points of its frame


@dataclass(frozen=True, eq=False)
class PoseFit:
    """The two unknown links of the chain, and how well the poses agree with them."""

    base_to_scene: FloatArray  # [4, 4] mm
    probe_to_flange: FloatArray  # [4, 4] mm, as given or found
    residuals_mm: FloatArray  # [N] of the probe's origin
    residuals_deg: FloatArray  # [N]
    position_std_mm: tuple[float, float, float] | None  # of base_to_scene, see PointFit; None: of a single pose
    angle_std_deg: tuple[float, float, float] | None


def register_poses(
    flange_to_base: Any,  # [N, 4, 4] mm
    probe_to_scene: Any,  # [N, 4, 4] mm
    probe_to_flange: Any = None,  # [4, 4] mm
) -> PoseFit:
    """base→scene from poses of the flange and where the probe was in the scene. One pose is enough; more tell errors.

    `probe_to_flange` is how the probe is mounted (None: its frame is the flange's).
    Raises InvalidPose, and InvalidArgument for other counts.
    """
    flanges, probes = _pairs(flange_to_base, probe_to_scene)
    mounting = np.eye(4) if probe_to_flange is None else check_poses(probe_to_flange, field="probe_to_flange")[0]
    in_base = flanges @ mounting
    transform = register_points(_as_points(in_base), _as_points(probes)).transform
    return _fit(transform, in_base, probes, mounting)


def register_poses_and_mounting(flange_to_base: Any, probe_to_scene: Any) -> PoseFit:  # [N, 4, 4] mm both
    """base→scene and probe→flange at once, from three poses or more (hand–eye calibration).

    Between two poses the flange moves by A and the probe by B, and A X = X B with X = probe→flange. With α and β the
    rotation vectors of A and B, R_X minimises Σ |α − R_X β|² (Park and Martin 1994), and t_X solves
    (R_A − I) t_X = R_X t_B − t_A.
    Raises InvalidPose, and InvalidArgument for other counts, too few poses, and a probe that was turned about one axis.
    """
    flanges, probes = _pairs(flange_to_base, probe_to_scene)
    if not LEAST_POSES <= len(flanges) <= MOST_POSES:
        raise InvalidArgument(
            f"flange_to_base must be {LEAST_POSES} to {MOST_POSES} poses where the mounting is unknown, got "
            f"{len(flanges)}",
            field="flange_to_base",
        )
    first, second = np.triu_indices(len(flanges), 1)
    flange_moves = np.linalg.inv(flanges[first]) @ flanges[second]
    probe_moves = np.linalg.inv(probes[first]) @ probes[second]
    alphas, betas = _rotation_vectors(flange_moves[:, :3, :3]), _rotation_vectors(probe_moves[:, :3, :3])
    turned = np.linalg.svd(alphas, compute_uv=False)[1] / np.sqrt(len(alphas))
    if np.degrees(turned) < LEAST_TURN_DEG:
        raise InvalidArgument(
            f"flange_to_base must turn by {LEAST_TURN_DEG:g}° or more about each of two axes where the mounting is "
            f"unknown, got {np.degrees(turned):.1f}° about the second",
            field="flange_to_base",
        )
    left, _, right = np.linalg.svd(betas.T @ alphas)
    rotation = right.T @ np.diag([1.0, 1.0, np.linalg.det(right.T @ left.T)]) @ left.T
    left_side = (flange_moves[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right_side = (probe_moves[:, :3, 3] @ rotation.T - flange_moves[:, :3, 3]).reshape(-1)
    mounting = np.eye(4)
    mounting[:3, :3] = rotation
    mounting[:3, 3] = np.linalg.lstsq(left_side, right_side, rcond=None)[0]
    return register_poses(flanges, probes, mounting)


def pose_residuals(poses: FloatArray, others: FloatArray) -> tuple[FloatArray, FloatArray]:  # [N, 4, 4] -> [N], [N]
    """The distance of the origins, mm, and the angle, degrees, of each pose from the other."""
    turns = others[:, :3, :3].transpose(0, 2, 1) @ poses[:, :3, :3]
    shifts_mm = np.linalg.norm(poses[:, :3, 3] - others[:, :3, 3], axis=1)
    return shifts_mm, np.degrees(np.linalg.norm(_rotation_vectors(turns), axis=1))


def _fit(base_to_scene: FloatArray, in_base: FloatArray, probes: FloatArray, mounting: FloatArray) -> PoseFit:
    residuals_mm, residuals_deg = pose_residuals(base_to_scene @ in_base, probes)
    deviations = _deviations(base_to_scene @ in_base, probes) if len(probes) > 1 else (None, None)
    return PoseFit(base_to_scene, mounting, residuals_mm, residuals_deg, *deviations)


def _deviations(
    fitted: FloatArray,  # [N, 4, 4]
    probes: FloatArray,  # [N, 4, 4]
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Of the middle of all points, mm, and of turns about it, degrees.

    The four points of a pose err together, so that each pose counts as one observation: the covariance is A⁻¹ B A⁻¹, A
    the sum of products of the points' slopes and B that of the poses' slopes (White 1980, clustered).
    """
    points, left = _as_points(fitted), _as_points(probes) - _as_points(fitted)
    x, y, z = (points - points.mean(axis=0)).T
    nothing, one = np.zeros_like(x), np.ones_like(x)
    slopes = np.array(  # of a point by shifts and turns
        [
            [one, nothing, nothing, nothing, z, -y],
            [nothing, one, nothing, -z, nothing, x],
            [nothing, nothing, one, y, -x, nothing],
        ]
    ).transpose(2, 0, 1)  # [4N, 3, 6]
    count = len(probes)
    of_poses = (left[:, None] @ slopes).reshape(count, -1, 6).sum(axis=1)
    inverse = np.linalg.inv(np.einsum("nij,nik->jk", slopes, slopes))
    covariance = inverse @ of_poses.T @ of_poses @ inverse * (count / (count - 1))
    shift_x, shift_y, shift_z, turn_x, turn_y, turn_z = np.sqrt(np.diag(covariance)).tolist()
    return (shift_x, shift_y, shift_z), tuple(np.degrees((turn_x, turn_y, turn_z)).tolist())


def _as_points(poses: FloatArray) -> FloatArray:  # [N, 4, 4] -> [4N, 3]
    points: FloatArray = (_ARMS @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]).reshape(-1, 3)
    return points


def _pairs(flange_to_base: Any, probe_to_scene: Any) -> tuple[FloatArray, FloatArray]:
    flanges = check_poses(flange_to_base, field="flange_to_base")
    probes = check_poses(probe_to_scene, field="probe_to_scene")
    if len(flanges) != len(probes) or not len(flanges):
        raise InvalidArgument(
            f"each pose of the flange needs one of the probe: got {len(flanges)} and {len(probes)}",
            field="probe_to_scene",
        )
    return flanges, probes


def _rotation_vectors(rotations: FloatArray) -> FloatArray:  # [N, 3, 3] -> [N, 3] rad
    """The axis times the angle of each rotation (cv2.Rodrigues, which is exact also near half a turn)."""
    import cv2

    return np.stack([cv2.Rodrigues(rotation)[0][:, 0] for rotation in rotations])
