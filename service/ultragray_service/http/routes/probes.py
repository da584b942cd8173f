"""What follows from a probe alone."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from fastapi import APIRouter, Body

from ..console_schemas import ImagePlane
from ..deps import problems
from ..schemas import ProbeBody

router = APIRouter(prefix="/v1/probes", tags=["probes"])

_LINES = 65


@router.post(":plane", responses=problems(401, 422))
async def probe_plane(probe: Annotated[ProbeBody, Body()]) -> ImagePlane:
    """Where the scan lines of a probe run: enough to draw its image, in the plane or in space, whatever its kind."""
    known = probe.probe()
    rows, columns = np.broadcast_arrays([0.0, 1.0], np.linspace(0.0, 1.0, _LINES)[:, None])
    ends = known.points_mm(rows, columns)[..., [0, 2]]  # [_LINES, 2, 2]: line, near or far, x and z
    lines_mm = [(x0, z0, x1, z1) for x0, z0, x1, z1 in ends.reshape(_LINES, 4).round(6).tolist()]
    return ImagePlane(face_depth_mm=known.face_depth_mm, pivot_depth_mm=known.pivot_depth_mm, lines_mm=lines_mm)
