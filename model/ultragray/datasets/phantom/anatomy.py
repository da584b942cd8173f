"""The anatomy of the phantom: the one map that scatterers, attenuation and labels are taken from.

Shapes are drawn straight and symmetric; `straightened` takes a point of the phantom to where it lies in the drawing.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import numpy.typing as npt

from ultragray.datasets.phantom import bone
from ultragray.datasets.phantom.bone import Floats
from ultragray.errors import InvalidArgument

LabelArray = npt.NDArray[np.uint8]

SKIN_MM = 1.7
FASCIA_MM = 1.0  # between the two leaves of the thoracolumbar fascia
VESSEL_RADIUS_MM = 2.7
SAC_DEPTH_MM, SAC_HALF_WIDTH_MM, SAC_HALF_DEPTH_MM = 47.0, 8.5, 6.2  # the dural sac, an elliptic tube
CANAL_HALF_WIDTH_MM = 11.0


class Tissue(IntEnum):
    """The tissue of a point of the phantom."""

    OUTSIDE = 0  # gel, before the skin
    SKIN = 1
    FAT = 2
    FASCIA = 3
    MUSCLE = 4
    LIGAMENT = 5
    BONE = 6
    BLOOD = 7
    FLUID = 8  # cerebrospinal fluid, with the nerve roots in it
    DISC = 9


def tissue_at(points_mm: Floats) -> LabelArray:  # [N, 3] -> [N]
    """The `Tissue` at each point of the phantom's frame, mm. Raises InvalidArgument for another shape."""
    points_mm = np.asarray(points_mm)
    if points_mm.ndim != 2 or points_mm.shape[1] != 3:
        raise InvalidArgument(f"points_mm must be [N, 3], got {list(points_mm.shape)}", field="points_mm")
    return tissue_drawn(straightened(points_mm))


def tissue_drawn(points: Floats) -> LabelArray:  # [N, 3] -> [N]
    """The tissue at each point of the straight, symmetric drawing."""
    x, _, z = points.T
    fascia = fascia_depth_mm(x)
    in_canal = (np.abs(x) < CANAL_HALF_WIDTH_MM) & (z > canal_roof_mm(x))
    labels = np.select(
        [z < 0.0, z < SKIN_MM, z < fascia, z < fascia + FASCIA_MM, in_canal, (np.abs(x) < 2.5) & (z < 33.0)],
        [Tissue.OUTSIDE, Tissue.SKIN, Tissue.FAT, Tissue.FASCIA, Tissue.FAT, Tissue.LIGAMENT],
        Tissue.MUSCLE,
    ).astype(np.uint8)
    labels[(np.abs(x) < bone.BODY_HALF_WIDTH_MM) & (z > bone.BODY_DEPTH_MM)] = Tissue.DISC
    labels[vessel_distance_mm(points) < 0.0] = Tissue.BLOOD
    labels[sac_distance_mm(points) < 0.0] = Tissue.FLUID
    deep = np.flatnonzero(z > bone.TOP_MM)
    labels[deep[bone.distance_mm(points[deep]) < 0.0]] = Tissue.BONE
    return labels


def straightened(points: Floats) -> Floats:  # [N, 3] -> [N, 3]
    """Takes the small bends out: nothing in a body is straight or symmetric, but for the skin under a probe."""
    x, y, z = points.T
    rise = np.clip(z / 8.0, 0.0, 1.0)
    sideways = 0.9 * np.sin(y / 27.0 + 0.4) + 0.4 * np.sin(z / 7.0 + x / 11.0)
    ripple = 0.45 * np.sin(x / 6.3 + y / 19.0 + 0.7) + 0.25 * np.sin(x / 2.9 + y / 7.0)
    return np.stack([x - rise * sideways, y, z - rise * (ripple + 0.02 * x)], axis=1)


def fascia_depth_mm(x: Floats) -> Floats:
    """The thoracolumbar fascia: over the two muscle bellies, down to the spinous processes between them."""
    depth: Floats = 10.0 - 1.6 * np.exp(-(((np.abs(x) - 14.0) / 9.0) ** 2)) + 2.0 * np.exp(-((x / 5.0) ** 2))
    return depth


def deep_fascia_depth_mm(x: Floats) -> Floats:
    """The middle layer of that fascia, in front of the erector spinae."""
    return 42.5 + 0.02 * (np.abs(x) - 22.0) ** 2


def canal_roof_mm(x: Floats) -> Floats:
    """The yellow ligament between the laminae."""
    return 36.0 + 0.28 * np.sqrt(x * x + 4.0)


def vessel_distance_mm(points: Floats) -> Floats:  # [N, 3] -> [N]
    """Distance from the wall of a vessel that winds along the right erector spinae, negative inside."""
    x, y, z = points.T
    centre_x, centre_z = 20.0 + 1.5 * np.sin(y / 14.0), 23.0 + 1.2 * np.sin(y / 19.0)
    distance: Floats = np.hypot(x - centre_x, z - centre_z) - VESSEL_RADIUS_MM
    return distance


def sac_distance_mm(points: Floats) -> Floats:  # [N, 3] -> [N]
    """Distance from the wall of the dural sac to first order, negative inside."""
    x, z = points[:, 0] / SAC_HALF_WIDTH_MM, (points[:, 2] - SAC_DEPTH_MM) / SAC_HALF_DEPTH_MM
    radius = np.hypot(x, z)
    steepness = np.hypot(x / SAC_HALF_WIDTH_MM, z / SAC_HALF_DEPTH_MM) / np.maximum(radius, 1e-9)
    distance: Floats = (radius - 1.0) / np.maximum(steepness, 1e-9)
    return distance
