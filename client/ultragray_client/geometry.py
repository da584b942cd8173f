"""Poses, as a caller writes them, and the places of pixels.

Convention. Lengths are millimetres, angles degrees. A pose takes the probe's frame (x lateral, y elevation, z axial) to
the scene's: p_scene = R p_probe + t. Worked value: `Placement((0, 0, 10), Quaternion(w=1, x=0, y=0, z=0))` is the
identity moved 10 mm along the scene's z, as `[[1,0,0,0],[0,1,0,0],[0,0,1,10],[0,0,0,1]]` is.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from ultragray_client.errors import InvalidArgument, InvalidPose
from ultragray_proto.codec import to_message
from ultragray_proto.v1 import geometry_pb2

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


def pose_message(pose: PoseLike, *, field: str = "pose") -> geometry_pb2.Pose:
    """Raises InvalidPose for what is not a Placement nor sixteen numbers [4, 4]; the service checks the numbers."""
    if isinstance(pose, Placement):
        return geometry_pb2.Pose(placement=to_message(pose, geometry_pb2.Placement))
    return geometry_pb2.Pose(matrix=matrix_message(pose, field=field, otherwise="a Placement or "))


def matrix_message(pose: npt.ArrayLike, *, field: str, otherwise: str = "") -> geometry_pb2.Matrix:
    """Raises InvalidPose for what is not sixteen numbers [4, 4]; `otherwise`: what else it may be, in words."""
    try:
        matrix = np.asarray(pose, np.float64)
    except (TypeError, ValueError):
        kind = type(pose).__name__
        raise InvalidPose(f"{field} must be {otherwise}numbers [4, 4], got {kind}", field=field) from None
    if matrix.shape != (4, 4):
        raise InvalidPose(f"{field} must be {otherwise}[4, 4], got {list(matrix.shape)}", field=field)
    return geometry_pb2.Matrix(values=matrix.ravel().tolist())


def pose_messages(poses: Iterable[PoseLike]) -> Iterator[geometry_pb2.Pose]:
    """The messages of many poses. Raises InvalidPose, naming the place of the pose."""
    return (pose_message(pose, field=f"poses[{index}]") for index, pose in enumerate(poses))


@dataclass(frozen=True)
class Picture:
    """The places of pixels in the image plane of the probe.

    Columns are mm along x (`column_unit` "mm"), or scan lines of a fan at degrees from its axis ("deg"); rows are mm
    along z, or mm of range. The first values are those of the centre of pixel (0, 0), the steps lead to the next one.
    """

    column_unit: str
    first_column: float
    first_row_mm: float
    column_step: float  # negative where left and right are exchanged
    row_step_mm: float

    def pixel_to_probe(self) -> FloatArray:  # [4, 4]
        """Takes (column, row, k, 1) to mm in the probe's frame, k in mm against the elevation y.

        Pixels are counted from 0 at their centres. Raises InvalidArgument where columns are angles.
        """
        if self.column_unit != "mm":
            raise InvalidArgument(
                f"no matrix takes pixels whose columns are in {self.column_unit} to mm; "
                "ask for square ones: display=Display(pixel_mm=...)",
                field="display.pixel_mm",
            )
        return np.array(
            [
                [self.column_step, 0.0, 0.0, self.first_column],
                [0.0, 0.0, -1.0, 0.0],
                [0.0, self.row_step_mm, 0.0, self.first_row_mm],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
