"""Real frames looked for in scenes, from the arrays of a caller to what the service found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ultragray_proto.v1 import rendering_pb2

from ..contract import Probe
from ..errors import InvalidArgument
from ..geometry import FloatArray, PoseLike, pose_message
from ..messages import message_of


@dataclass(frozen=True, eq=False)
class Localization:
    """Where a real frame was taken, and how certain that is. The standard deviations hold where `is_found` does."""

    pose: FloatArray  # [4, 4] mm, probe to scene; not to be used where it is not found
    flange_to_base: FloatArray | None  # [4, 4] mm, the same as the pose of the registration; None: none was named
    registration: str | None  # that led the start into the scene
    similarity: float  # correlation of the structures of the frame and of the scene there, -1 to 1
    is_found: bool  # whether that is as high as only the right place has it
    position_std_mm: tuple[float, float, float]  # along the probe's lateral, elevation and axial axis
    angle_std_deg: tuple[float, float, float]  # about them, through the middle of the image
    shift_mm: float  # of the middle of the image, from the start
    turn_deg: float
    scene: str
    scene_sha256: str  # of the scene file
    renderer: str  # name, version and backend
    queue_ms: float
    search_ms: float


def localize_message(
    scene: str,
    image: npt.ArrayLike | bytes,
    start: PoseLike,
    probe: Probe | None,
    registration: str | None,
    within_mm: float,
    within_deg: float,
) -> rendering_pb2.LocalizeRequest:
    """The request of a search. Raises InvalidArgument for what is no grey image, and InvalidPose."""
    asked = {"probe": probe, "registration": registration, "within_mm": within_mm, "within_deg": within_deg}
    request = message_of(asked, rendering_pb2.LocalizeRequest, scene=scene, start=pose_message(start, field="start"))
    if isinstance(image, bytes):
        request.image = image
        return request
    pixels = np.asarray(image)
    if pixels.ndim != 2 or (pixels.dtype != np.uint8 and pixels.dtype.kind != "f"):
        raise InvalidArgument(
            "image must be the bytes of a PNG file or grey values [H, W], uint8 or floating point, "
            f"got {pixels.dtype} {list(pixels.shape)}",
            field="image",
        )
    if pixels.dtype != np.uint8:
        if not (np.isfinite(pixels).all() and pixels.min(initial=0.0) >= 0.0 and pixels.max(initial=0.0) <= 1.0):
            raise InvalidArgument("image of floating point must hold finite values in [0, 1]", field="image")
        pixels = np.rint(255.0 * pixels).astype(np.uint8)
    request.image = pixels.tobytes()
    request.image_height, request.image_width = pixels.shape
    return request
