"""Poses and probes, as a caller writes them.

Convention. Lengths are millimetres, angles degrees. A pose takes the probe's frame (x lateral, y elevation, z axial) to
the scene's: p_scene = R p_probe + t. Worked value: `Placement((0, 0, 10), Quaternion(w=1, x=0, y=0, z=0))` is the
identity moved 10 mm along the scene's z, as `[[1,0,0,0],[0,1,0,0],[0,0,1,10],[0,0,0,1]]` is.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ultragray_proto.v1 import geometry_pb2

from .errors import InvalidPose

FloatArray: TypeAlias = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Quaternion:
    """A rotation from the probe to the scene, of norm 1 within 1e-3."""

    w: float
    x: float
    y: float
    z: float


@dataclass(frozen=True)
class Placement:
    """A pose as the probe's position (x, y, z) in the scene, mm, and its rotation."""

    position_mm: tuple[float, float, float]
    quaternion: Quaternion


PoseLike: TypeAlias = Placement | npt.ArrayLike  # an array is [4, 4], mm


@dataclass(frozen=True)
class LinearProbe:
    """Parallel scan lines; 0 < width, 0 ≤ near < far."""

    width_mm: float
    near_mm: float
    far_mm: float


@dataclass(frozen=True)
class ConvexProbe:
    """A fan of scan lines; `near_mm` is the radius of the face; 0 < angle ≤ 175."""

    opening_angle_deg: float
    near_mm: float
    far_mm: float


@dataclass(frozen=True)
class PhasedProbe:
    """A fan of scan lines from the centre of the face; 0 < angle ≤ 175."""

    opening_angle_deg: float
    far_mm: float


Probe: TypeAlias = LinearProbe | ConvexProbe | PhasedProbe
_PROBES = {"linear": LinearProbe, "convex": ConvexProbe, "phased": PhasedProbe}
_PROBE_NAMES = {cls: name for name, cls in _PROBES.items()}


def pose_message(pose: PoseLike, *, field: str = "pose") -> geometry_pb2.Pose:
    """Raises InvalidPose for what is not a Placement nor sixteen numbers [4, 4]; the service checks the numbers."""
    if isinstance(pose, Placement):
        x, y, z = pose.position_mm
        return geometry_pb2.Pose(
            placement=geometry_pb2.Placement(
                position_mm=geometry_pb2.Position(x=x, y=y, z=z),
                quaternion=geometry_pb2.Quaternion(**asdict(pose.quaternion)),
            )
        )
    try:
        matrix = np.asarray(pose, dtype=np.float64)
    except (TypeError, ValueError):
        raise InvalidPose(
            f"{field} must be a Placement or numbers [4, 4], got {type(pose).__name__}", field=field
        ) from None
    if matrix.shape != (4, 4):
        raise InvalidPose(f"{field} must be a Placement or [4, 4], got {list(matrix.shape)}", field=field)
    return geometry_pb2.Pose(matrix=geometry_pb2.Matrix(values=matrix.ravel().tolist()))


def matrix_from_message(message: geometry_pb2.Matrix) -> FloatArray:  # [4, 4] mm
    """A pose that the service tells."""
    return np.array(message.values, dtype=np.float64).reshape(4, 4)


def probe_message(probe: Probe) -> geometry_pb2.Probe:
    """The service checks the numbers."""
    return geometry_pb2.Probe(**{_PROBE_NAMES[type(probe)]: asdict(probe)})


def probe_from_message(message: geometry_pb2.Probe) -> Probe | None:
    """The probe; None where the message holds none."""
    kind = message.WhichOneof("kind")
    if kind is None:
        return None
    values: Any = {
        field.name: getattr(getattr(message, kind), field.name)
        for field in message.DESCRIPTOR.fields_by_name[kind].message_type.fields
    }
    probe: Probe = _PROBES[kind](**values)
    return probe
