"""Registrations: how the frame of a robot's flange or a tracker's marker leads into a scene, found from points or from
poses, and kept as a file.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ultragray.contract import Contract, described, from_dict, to_dict
from ultragray.errors import InvalidArgument, InvalidPose
from ultragray.files import require_version, write_whole
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import FloatArray
from ultragray.geometry.rotations import transforms_of

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
        return float(np.sqrt(np.square(self.residuals_mm).mean()))


def register_points(points: Any, targets: Any) -> PointFit:  # [N, 3] mm both
    """The rigid transform that takes points onto targets with the least squared distance.

    Raises InvalidArgument for fewer than three, for other counts of targets, for points on a line or in one place, and
    for targets that are the points' mirror image, as where one of the frames is left-handed.
    """
    points, targets = _checked(points, "points"), _checked(targets, "targets")
    if len(points) != len(targets):
        raise InvalidArgument(f"each point needs its target: got {len(points)} and {len(targets)}", field="targets")
    for field, positions in (("points", points), ("targets", targets)):
        extents = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
        if extents[1] <= LEAST_SPREAD * extents[0] or extents[0] == 0.0:
            raise InvalidArgument(
                f"{field} lie on a line, or in one place: a turn about it stays unknown; add one beside it", field=field
            )
    middle, target_middle = points.mean(axis=0), targets.mean(axis=0)
    rotation = _rotation(points - middle, targets - target_middle)
    transform = transforms_of(rotation, target_middle - rotation @ middle)
    centred = (points - middle) @ rotation.T
    residuals = centred - (targets - target_middle)
    position_std_mm, angle_std_deg = _deviations(centred, residuals)
    return PointFit(transform, np.linalg.norm(residuals, axis=1), position_std_mm, angle_std_deg)


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
    residuals: FloatArray,  # [N, 3]
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Standard deviations of the middle, mm, and of turns about it, degrees: of 3N residuals and six unknowns."""
    variance = float(np.square(residuals).sum()) / (residuals.size - 6)
    spread = np.square(centred).sum() * np.eye(3) - centred.T @ centred
    turns = np.degrees(np.sqrt(variance * np.diag(np.linalg.inv(spread))))
    position = float(np.sqrt(variance / len(residuals)))
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


# Registration from poses of the probe that are known in the robot's frame and in the scene's.
#
# Convention. probe→scene = base→scene · flange→base · probe→flange, all [4, 4], mm. For a tracked probe the base is
# the tracker, and the flange the marker on the probe.

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
    fitted = transform @ in_base
    deviations = _pose_deviations(fitted, probes) if len(probes) > 1 else (None, None)
    return PoseFit(transform, mounting, *pose_residuals(fitted, probes), *deviations)


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
    mounting = transforms_of(rotation, np.linalg.lstsq(left_side, right_side, rcond=None)[0])
    return register_poses(flanges, probes, mounting)


def pose_residuals(poses: FloatArray, others: FloatArray) -> tuple[FloatArray, FloatArray]:  # [N, 4, 4] -> [N], [N]
    """The distance of the origins, mm, and the angle, degrees, of each pose from the other."""
    turns = others[:, :3, :3].transpose(0, 2, 1) @ poses[:, :3, :3]
    shifts_mm = np.linalg.norm(poses[:, :3, 3] - others[:, :3, 3], axis=1)
    return shifts_mm, np.degrees(np.linalg.norm(_rotation_vectors(turns), axis=1))


def _pose_deviations(
    fitted: FloatArray,  # [N, 4, 4]
    probes: FloatArray,  # [N, 4, 4]
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Of the middle of all points, mm, and of turns about it, degrees.

    The four points of a pose err together, so that each pose counts as one observation: the covariance is A⁻¹ B A⁻¹, A
    the sum of products of the points' slopes and B that of the poses' slopes (White 1980, clustered).
    """
    points, residuals = _as_points(fitted), _as_points(probes) - _as_points(fitted)
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
    of_poses = (residuals[:, None] @ slopes).reshape(count, -1, 6).sum(axis=1)
    inverse = np.linalg.inv(np.einsum("nij,nik->jk", slopes, slopes))
    covariance = inverse @ of_poses.T @ of_poses @ inverse * (count / (count - 1))
    shift_x, shift_y, shift_z, turn_x, turn_y, turn_z = np.sqrt(np.diag(covariance)).tolist()
    return (shift_x, shift_y, shift_z), tuple(np.degrees((turn_x, turn_y, turn_z)).tolist())


def _as_points(poses: FloatArray) -> FloatArray:  # [N, 4, 4] -> [4N, 3]
    return (_ARMS @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]).reshape(-1, 3)


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


FORMAT_VERSION = 1
MAX_FILE_BYTES = 1 << 20

Row = tuple[float, float, float, float]
Rows = tuple[Row, Row, Row, Row]
_IDENTITY: Rows = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


@dataclass(frozen=True, kw_only=True)
class Registration(Contract):
    """How the frame of a robot or tracker lies to a scene's, and the probe to its flange or marker.

    Raises InvalidPose for what is not rigid, InvalidArgument.
    """

    base_to_scene: Rows = described("From the robot's base, or the tracker, to the scene: 4x4, mm.", error=InvalidPose)
    probe_to_flange: Rows = described(
        "From the probe to the flange, or the marker on it: 4x4, mm. Default: they are the same.",
        _IDENTITY,
        error=InvalidPose,
    )
    residual_mm: float | None = described("Root mean square; null: not known.", None, low=0.0, high=1e6)
    residual_deg: float | None = described("Likewise, of poses.", None, low=0.0, high=180.0)
    position_std_mm: tuple[float, float, float] | None = described(
        "Standard deviations of base_to_scene, where it was found; null: not known.", None, low=0.0, high=1e6
    )
    angle_std_deg: tuple[float, float, float] | None = described(
        "Of its turns, about the axes of the scene.", None, low=0.0, high=1e6
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("base_to_scene", "probe_to_flange"):
            exact = check_poses(getattr(self, name), field=name)[0]
            object.__setattr__(self, name, rows(exact))

    @cached_property
    def _links(self) -> tuple[FloatArray, FloatArray]:  # [4, 4] both
        return np.array(self.base_to_scene), np.array(self.probe_to_flange)

    def probe_to_scene(self, flange_to_base: FloatArray) -> FloatArray:  # [..., 4, 4] mm, exact -> [..., 4, 4]
        """The poses of the probe in the scene, of poses of the flange in the base."""
        base_to_scene, probe_to_flange = self._links
        return base_to_scene @ flange_to_base @ probe_to_flange

    def marker_to_scene(self, marker_to_base: FloatArray) -> FloatArray:  # [..., 4, 4] mm, exact -> [..., 4, 4]
        """The poses in the scene of something else in the base than the probe, such as a needle's marker."""
        return self._links[0] @ marker_to_base

    def in_base(self, to_scene: FloatArray) -> FloatArray:  # [..., 4, 4] mm -> [..., 4, 4]
        """Transforms into the scene as such into the base."""
        return np.linalg.inv(self._links[0]) @ to_scene

    def flange_to_base(self, probe_to_scene: FloatArray) -> FloatArray:  # [..., 4, 4] mm, exact -> [..., 4, 4]
        """The poses of the flange in the base, of poses of the probe in the scene."""
        base_to_scene, probe_to_flange = self._links
        return np.linalg.inv(base_to_scene) @ probe_to_scene @ np.linalg.inv(probe_to_flange)


def rows(pose: FloatArray) -> Rows:  # [4, 4]
    first, second, third, fourth = ((float(a), float(b), float(c), float(d)) for a, b, c, d in pose)
    return first, second, third, fourth


def save_registration(path: str | Path, registration: Registration) -> None:
    document = {"format_version": FORMAT_VERSION, **to_dict(registration)}
    write_whole(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def load_registration(path: str | Path) -> Registration:
    """The registration of a file. Raises InvalidArgument, naming the file and what is wrong with it."""
    path = Path(path)
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise ValueError("it is larger than a registration is")
        document: Any = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(document, dict):
            raise ValueError("it holds no object")
        require_version(document.pop("format_version", None), FORMAT_VERSION)
        return from_dict(Registration, document)
    except (OSError, ValueError, RecursionError) as error:
        raise InvalidArgument(f"{path} is no registration that can be read: {error}", field="registration") from None
