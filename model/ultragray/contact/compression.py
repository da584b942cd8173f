"""Tissue under pressure: compressed evenly between the face and the far end of the image, which stays where it was.

Of a scan line of length L from the face, pressed in by d, the sample at depth z shows the tissue that lay at
z − d·(1 − z/L) before: d above the face at the face itself, the same place at the far end. This is what a probe sees
that is d farther out along its middle scan line and whose lines are longer by d, with as many samples.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ultragray.probe import FloatArray, Probe

MOST_COMPRESSION = 0.5  # of the depth of the image: a face pressed in farther moves on through the tissue


def at_rest(probe: Probe, pressed_mm: float) -> tuple[Probe, FloatArray]:  # -> [4, 4] mm
    """The probe, and its motion in its own frame, that see tissue at rest as this one sees it pressed."""
    face, depth = probe.face_depth_mm, probe.far_mm - probe.face_depth_mm
    pressed = min(pressed_mm, MOST_COMPRESSION * depth)
    stretch = 1.0 + pressed / depth
    longer = probe.ending_at(face + stretch * depth)
    if probe.near_mm != face:
        longer = replace(longer, near_mm=face + stretch * (probe.near_mm - face))  # type: ignore[type-var]
    _, directions = probe.scan_lines(1)
    motion = np.eye(4)
    motion[:3, 3] = -pressed * directions[0]
    return longer, motion
