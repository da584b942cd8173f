"""What follows from a probe alone."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from fastapi import APIRouter, Body

from ultragray import LinearProbe
from ultragray.probe import FloatArray

from ..console_schemas import ImagePlane
from ..deps import problems
from ..schemas import ProbeBody

router = APIRouter(prefix="/v1/probes", tags=["probes"])

_LINES = 65


@router.post(":plane", responses=problems(401, 422))
async def probe_plane(probe: Annotated[ProbeBody, Body()]) -> ImagePlane:
    """Where the scan lines of a probe run: enough to draw its image, in the plane or in space, whatever its kind."""
    known = probe.probe()
    origins, directions = (_at_edges(lines) for lines in known.scan_lines(_LINES - 1))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ends = [(origins + depth_mm * directions)[:, [0, 2]] for depth_mm in (known.near_mm, known.far_mm)]
    face_depth_mm = 0.0 if isinstance(known, LinearProbe) else known.near_mm
    return ImagePlane(face_depth_mm=face_depth_mm, lines_mm=np.concatenate(ends, axis=1).round(6).tolist())


def _at_edges(lines: FloatArray) -> FloatArray:  # [W, 3] -> [W + 1, 3]
    """What is told of the middles of scan lines, at the edges between them and at both ends."""
    beyond = np.concatenate([[2 * lines[0] - lines[1]], lines, [2 * lines[-1] - lines[-2]]])
    edges: FloatArray = (beyond[1:] + beyond[:-1]) / 2
    return edges
