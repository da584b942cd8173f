"""What follows from a probe alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from fastapi import APIRouter
from starlette.requests import Request

from ultragray.contract import described
from ultragray.probe import Probe
from ultragray_service.http.deps import problems
from ultragray_service.http.reading.json_body import body_schema, read_json_body

router = APIRouter(prefix="/v1/probes", tags=["probes"])

_LINES = 65


@dataclass(frozen=True)
class ImagePlane:
    """The image plane of a probe, told by its scan lines: x lateral, z axial, mm."""

    face_depth_mm: float = described("Depth of the face, from which a scanner counts.")
    pivot_depth_mm: float = described(
        "Where the middle of the face lies on the axial axis: a probe is turned about it."
    )
    lines_mm: list[tuple[float, float, float, float]] = described(
        "From the left edge of the image to its right one, at even distances: x and z where the image begins, x and z "
        "where it ends."
    )


@router.post(":plane", openapi_extra=body_schema(Probe), responses=problems(401, 413, 415, 422))
async def probe_plane(request: Request) -> ImagePlane:
    """Where the scan lines of a probe run: enough to draw its image, in the plane or in space, whatever its kind."""
    probe = await read_json_body(request, Probe)
    rows, columns = np.broadcast_arrays([0.0, 1.0], np.linspace(0.0, 1.0, _LINES)[:, None])
    ends = probe.points_mm(rows, columns)[..., [0, 2]]  # [_LINES, 2, 2]: line, near or far, x and z
    lines_mm = [(x0, z0, x1, z1) for x0, z0, x1, z1 in ends.reshape(_LINES, 4).round(6).tolist()]
    return ImagePlane(probe.face_depth_mm, probe.pivot_depth_mm, lines_mm)
