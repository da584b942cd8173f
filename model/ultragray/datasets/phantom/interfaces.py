"""The surfaces of the phantom that reflect: bone, skin, fasciae, septa, vessel wall, dura.

Each is the zero of a function of the straight drawing, roughly a distance in mm, where `present` says so.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ultragray.datasets.phantom import anatomy, bone
from ultragray.datasets.phantom.bone import Floats
from ultragray.datasets.phantom.noise import LatticeNoise

Level = Callable[[Floats], Floats]  # [N, 3] -> [N]
Present = Callable[[Floats], npt.NDArray[np.bool_]]  # [N, 3] -> [N]


@dataclass(frozen=True)
class Interface:
    """One reflecting surface.

    Amplitudes are in dB over the scatterers of muscle: `specular_db` for a beam along the normal, falling off as a
    Gaussian of the angle, and `diffuse_db` from everywhere.
    """

    level: Level
    present: Present
    depths_mm: tuple[float, float]  # of the phantom, outside which it need not be looked for
    specular_db: float
    diffuse_db: float
    lobe_deg: float
    roughness_mm: float


_BUNDLES = LatticeNoise(11, (3.2, 16.0, 1.5))
_FIBRES = LatticeNoise(12, (2.3, 11.0, 1.0))
_LOBULES = LatticeNoise(13, (6.0, 9.0, 1.3))
_ROOTS = LatticeNoise(14, (1.7, 24.0, 1.5))


def fascicles(points: Floats) -> Floats:  # [N, 3] -> [N] in [-1, 1]
    """Bundles of muscle fibres along the spine, leaning out and down to the flanks."""
    return _BUNDLES(_along_fibres(points))


def _along_fibres(points: Floats) -> Floats:  # [N, 3] -> [N, 3]
    x, y, z = points.T
    side = np.abs(x)
    lean = 0.12 * side + 4.5 * (1.0 - np.exp(-((side / 13.0) ** 2)))
    return np.stack([x + 0.10 * np.sign(x) * y, y, z - lean - 0.06 * y], axis=1)


def _perimysium(points: Floats) -> Floats:
    return 1.2 * _BUNDLES(_along_fibres(points))


def _endomysium(points: Floats) -> Floats:
    return 0.9 * _FIBRES(_along_fibres(points))


def _fat_septa(points: Floats) -> Floats:
    return 1.2 * _LOBULES(points)


def _nerve_roots(points: Floats) -> Floats:
    return 1.2 * (_ROOTS(points) - 0.35)


def _muscle_septa(points: Floats) -> Floats:
    """Between multifidus and longissimus, and between longissimus and iliocostalis."""
    side, y, z = np.abs(points[:, 0]), points[:, 1], points[:, 2]
    u = (z - 11.0) / 20.0
    wave = 0.35 * np.sin(14.0 * u + y / 12.0)
    inner, outer = side - (5.0 + 10.0 * u + wave), side - (18.0 + 9.0 * u + wave)
    return np.where(np.abs(inner) < np.abs(outer), inner, outer)


def _everywhere(points: Floats) -> npt.NDArray[np.bool_]:
    return np.ones(len(points), dtype=np.bool_)


def _in_muscle(points: Floats) -> npt.NDArray[np.bool_]:
    return np.asarray(anatomy.tissue_drawn(points) == anatomy.Tissue.MUSCLE)


def _in_fat(points: Floats) -> npt.NDArray[np.bool_]:
    x, _, z = points.T
    return np.asarray((z > anatomy.SKIN_MM + 0.3) & (z < anatomy.fascia_depth_mm(x) - 0.3))


def _in_sac(points: Floats) -> npt.NDArray[np.bool_]:
    return np.asarray(anatomy.sac_distance_mm(points) < -0.8)


def _outside_bone(points: Floats) -> npt.NDArray[np.bool_]:
    return np.asarray(bone.distance_mm(points) > 0.3)


def _beside(half_width_mm: float) -> Present:
    return lambda points: _outside_bone(points) & (np.abs(points[:, 0]) > half_width_mm)


def _within(half_width_mm: float) -> Present:
    return lambda points: _outside_bone(points) & (np.abs(points[:, 0]) < half_width_mm)


def _sheet(depth_mm: Callable[[Floats], Floats]) -> Level:
    """A surface at a depth that depends on x."""
    return lambda points: points[:, 2] - depth_mm(points[:, 0])


INTERFACES: tuple[Interface, ...] = (
    Interface(bone.distance_mm, _everywhere, (10.0, 66.0), 38.0, 18.0, 26.0, 0.05),
    Interface(_sheet(lambda x: 0.5 + 0.0 * x), _everywhere, (0.0, 1.5), 26.0, 10.0, 25.0, 0.05),
    Interface(_sheet(lambda x: anatomy.SKIN_MM + 0.0 * x), _everywhere, (0.5, 3.0), 20.0, 6.0, 20.0, 0.05),
    Interface(_fat_septa, _in_fat, (1.0, 13.0), 15.0, 2.0, 18.0, 0.05),
    Interface(_sheet(anatomy.fascia_depth_mm), _outside_bone, (7.0, 14.0), 27.0, 8.0, 16.0, 0.04),
    Interface(
        _sheet(lambda x: anatomy.fascia_depth_mm(x) + anatomy.FASCIA_MM),
        _outside_bone,
        (8.0, 15.0),
        22.0,
        6.0,
        16.0,
        0.04,
    ),
    Interface(_sheet(anatomy.deep_fascia_depth_mm), _beside(16.0), (39.0, 52.0), 22.0, 6.0, 16.0, 0.04),
    Interface(_muscle_septa, _in_muscle, (10.0, 33.0), 16.0, 8.0, 18.0, 0.06),
    Interface(_perimysium, _in_muscle, (9.0, 66.0), 20.0, 2.0, 13.0, 0.05),
    Interface(_endomysium, _in_muscle, (9.0, 66.0), 9.0, -6.0, 13.0, 0.05),
    Interface(anatomy.vessel_distance_mm, _everywhere, (16.0, 30.0), 24.0, 8.0, 20.0, 0.04),
    Interface(_sheet(anatomy.canal_roof_mm), _within(9.0), (33.0, 41.0), 20.0, 8.0, 20.0, 0.05),
    Interface(anatomy.sac_distance_mm, _outside_bone, (38.0, 56.0), 22.0, 6.0, 18.0, 0.04),
    Interface(_nerve_roots, _in_sac, (40.0, 54.0), 1.0, -9.0, 20.0, 0.05),
    Interface(_sheet(lambda x: bone.BODY_DEPTH_MM + 0.0 * x), _within(17.0), (52.0, 57.0), 22.0, 8.0, 18.0, 0.05),
)
