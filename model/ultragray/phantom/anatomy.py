"""The anatomy of the phantom: bone, tissues, interfaces, and the acoustics of each tissue.

Lumbar vertebrae are a signed distance, mm, negative inside, before the small bends of `straightened`. One vertebra in
its own frame: x lateral, y caudal, z depth, the origin on the skin over the middle of its level. It repeats every 35 mm
along y, as the lumbar spine does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ultragray.errors import InvalidArgument
from ultragray.geometry.probe import FloatArray
from ultragray.learn.sweep import IntArray

Floats: TypeAlias = npt.NDArray[np.floating[Any]]  # computed in the type that comes in: float32 is twice as fast
Place: TypeAlias = tuple[Floats, Floats | float, Floats]  # x, y, z, each [N]
Triple: TypeAlias = tuple[float, float, float]

LEVEL_SPACING_MM = 35.0
TOP_MM = 12.0  # no bone above
BODY_DEPTH_MM = 54.5  # posterior wall of the vertebral bodies
BODY_HALF_WIDTH_MM = 19.0
BODY_HALF_LENGTH_MM = 13.0  # along the spine; discs fill the rest of a level
LAMINA_SLOPE = 0.33  # a lamina rises towards its caudal edge: the saw-tooth of paramedian views
BLEND_MM = 2.0  # radius with which the parts run into each other


def distance_mm(points: Floats) -> Floats:  # [N, 3] -> [N]
    local = _local(points)
    half = (BODY_HALF_WIDTH_MM - 2.0, BODY_HALF_LENGTH_MM - 2.0, 13.0)
    body = _box(local, (0.0, 0.0, BODY_DEPTH_MM + 15.0), half, 2.0)
    return np.minimum(_posterior(local), body)


def _local(points: Floats) -> Place:
    """x without its side, y from the nearest level in [−17.5, 17.5) mm, z."""
    x, y, z = points.T
    return np.abs(x), (y + LEVEL_SPACING_MM / 2) % LEVEL_SPACING_MM - LEVEL_SPACING_MM / 2, z


def _posterior(local: Place) -> Floats:
    """The bone behind the canal: spinous process, laminae, articular and transverse processes."""
    x, y, z = local
    crest = _capsule(local, (0.0, -3.0, 17.6), (0.0, 10.0, 17.0), 3.5)
    blade = _box(local, (0.0, 3.5, 24.0), (0.6, 8.0, 9.0), 1.6)
    across = _capsule((x, 0.0, z + LAMINA_SLOPE * y), (1.0, 0.0, 31.4), (13.0, 0.0, 36.4), 0.0)
    lamina = np.hypot(across, np.maximum(np.abs(y - 1.0) - 7.5, 0.0)) - 3.4  # that bar, drawn out along y
    pillar = _capsule(local, (16.0, -16.0, 39.5), (14.0, 13.5, 34.0), 4.0)
    transverse = _capsule(local, (14.0, -9.0, 41.0), (28.0, -11.0, 43.0), 3.6)
    joined = _blend(_blend(crest, blade), lamina)
    return _blend(_blend(joined, pillar), transverse)


def _capsule(place: Place, start: Triple, end: Triple, radius: float) -> Floats:
    (x, y, z), (a, b, c) = place, start
    u, v, w = end[0] - a, end[1] - b, end[2] - c
    t = np.clip(((x - a) * u + (y - b) * v + (z - c) * w) / (u * u + v * v + w * w), 0.0, 1.0)
    return _length(x - a - t * u, y - b - t * v, z - c - t * w) - radius


def _box(place: Place, middle: Triple, half: Triple, radius: float) -> Floats:
    x, y, z = (np.abs(at - m) - h for at, m, h in zip(place, middle, half, strict=True))
    inside = np.minimum(np.maximum(np.maximum(x, y), z), 0.0)
    return _length(np.maximum(x, 0.0), np.maximum(y, 0.0), np.maximum(z, 0.0)) + inside - radius


def _length(x: Floats, y: Floats, z: Floats) -> Floats:
    return np.sqrt(x * x + y * y + z * z)


def _blend(a: Floats, b: Floats) -> Floats:
    """The union of two solids, its edges rounded."""
    overlap = np.maximum(BLEND_MM - np.abs(a - b), 0.0)
    return np.minimum(a, b) - overlap * overlap / (4.0 * BLEND_MM)


# The anatomy of the phantom: the one map that scatterers, attenuation and labels are taken from.
#
# Shapes are drawn straight and symmetric; `straightened` takes a point of the phantom to where it lies in the
# drawing.

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


def tissue_drawn(points: Floats) -> LabelArray:  # [N, 3] -> [N]
    x, _, z = points.T
    fascia = fascia_depth_mm(x)
    in_canal = (np.abs(x) < CANAL_HALF_WIDTH_MM) & (z > canal_roof_mm(x))
    labels = np.select(
        [z < 0.0, z < SKIN_MM, z < fascia, z < fascia + FASCIA_MM, in_canal, (np.abs(x) < 2.5) & (z < 33.0)],
        [Tissue.OUTSIDE, Tissue.SKIN, Tissue.FAT, Tissue.FASCIA, Tissue.FAT, Tissue.LIGAMENT],
        Tissue.MUSCLE,
    ).astype(np.uint8)
    labels[(np.abs(x) < BODY_HALF_WIDTH_MM) & (z > BODY_DEPTH_MM)] = Tissue.DISC
    labels[vessel_distance_mm(points) < 0.0] = Tissue.BLOOD
    labels[sac_distance_mm(points) < 0.0] = Tissue.FLUID
    deep = np.flatnonzero(z > TOP_MM)
    labels[deep[distance_mm(points[deep]) < 0.0]] = Tissue.BONE
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


SPEED_MM_PER_US = 1.54
FREQUENCY_MHZ = 5.0
FREQUENCIES_MHZ = (3.8, 5.0, 6.2)  # whose echoes a scanner averages for smoother speckle
PULSE_SIGMA_MM = 0.17  # of the echo's envelope, along depth
FOCUS_MM = 32.0
ELEVATION_REACH = 2.5  # standard deviations of the slice


@dataclass(frozen=True)
class Acoustics:
    """Attenuation one way in dB/(cm·MHz); backscattered amplitude in dB over that of muscle."""

    attenuation: float
    backscatter_db: float


ACOUSTICS: dict[Tissue, Acoustics] = {
    Tissue.OUTSIDE: Acoustics(0.0, -math.inf),
    Tissue.SKIN: Acoustics(0.9, 14.0),
    Tissue.FAT: Acoustics(0.5, -4.0),
    Tissue.FASCIA: Acoustics(0.8, 4.0),
    Tissue.MUSCLE: Acoustics(0.6, 0.0),
    Tissue.LIGAMENT: Acoustics(0.8, 4.0),
    Tissue.BONE: Acoustics(20.0, 16.0),
    Tissue.BLOOD: Acoustics(0.15, -34.0),
    Tissue.FLUID: Acoustics(0.02, -28.0),
    Tissue.DISC: Acoustics(0.9, -2.0),
}
COMPENSATED = 0.6  # dB/(cm·MHz) that the scanner's time-gain compensation expects


def lateral_sigma_mm(depth_mm: Floats) -> Floats:
    """Width of the beam in the image plane, there and back."""
    sigma: Floats = np.hypot(0.34, 0.011 * (depth_mm - FOCUS_MM))
    return sigma


def elevation_sigma_mm(depth_mm: Floats) -> Floats:
    """Thickness of the slice: 1.4 mm at half amplitude in the focus of the lens, more before and behind."""
    sigma: Floats = np.hypot(0.6, 0.022 * (depth_mm - FOCUS_MM))
    return sigma


def elevation_weight(elevation_mm: Floats, depth_mm: Floats) -> Floats:
    """The share of an echo from beside the image plane that the beam leaves."""
    sigmas = elevation_mm / elevation_sigma_mm(depth_mm)
    return np.where(np.abs(sigmas) < ELEVATION_REACH, np.exp(-0.5 * sigmas * sigmas), 0.0)


_PERIOD = 32  # lattice cells, a power of two
_LAST = _PERIOD - 1


class LatticeNoise:
    """Values in [−1, 1] at the nodes of a lattice with cells of a given size, interpolated smoothly between them."""

    def __init__(self, seed: int, cell_mm: Triple) -> None:
        nodes = np.random.default_rng(seed).uniform(-1.0, 1.0, (_PERIOD, _PERIOD, _PERIOD))
        self._nodes = nodes.astype(np.float32)
        self._cell_mm = cell_mm

    def __call__(self, points: Floats) -> Floats:  # [N, 3] -> [N]
        (i, u), (j, v), (k, w) = (self._cell(points[:, axis] / size) for axis, size in enumerate(self._cell_mm))
        nodes = self._nodes

        def along_z(i: IntArray, j: IntArray) -> Floats:
            near = nodes[i, j, k]
            values: Floats = near + w * (nodes[i, j, (k + 1) & _LAST] - near)
            return values

        def along_y(i: IntArray) -> Floats:
            near = along_z(i, j)
            return near + v * (along_z(i, (j + 1) & _LAST) - near)

        near = along_y(i)
        return near + u * (along_y((i + 1) & _LAST) - near)

    @staticmethod
    def _cell(scaled: Floats) -> tuple[IntArray, Floats]:
        """The node before each place, and how far the place is on the way to the next."""
        whole = np.floor(scaled)
        part = scaled - whole
        return whole.astype(np.int64) & _LAST, part * part * (3.0 - 2.0 * part)


# The surfaces of the phantom that reflect: bone, skin, fasciae, septa, vessel wall, dura.
#
# Each is the zero of a function of the straight drawing, roughly a distance in mm, where `present` says so.

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
    return np.asarray(tissue_drawn(points) == Tissue.MUSCLE)


def _in_fat(points: Floats) -> npt.NDArray[np.bool_]:
    x, _, z = points.T
    return np.asarray((z > SKIN_MM + 0.3) & (z < fascia_depth_mm(x) - 0.3))


def _outside_bone(points: Floats) -> npt.NDArray[np.bool_]:
    return np.asarray(distance_mm(points) > 0.3)


def _beside(half_width_mm: float) -> Present:
    return lambda points: _outside_bone(points) & (np.abs(points[:, 0]) > half_width_mm)


def _within(half_width_mm: float) -> Present:
    return lambda points: _outside_bone(points) & (np.abs(points[:, 0]) < half_width_mm)


def _sheet(depth_mm: Callable[[Floats], Floats]) -> Level:
    return lambda points: points[:, 2] - depth_mm(points[:, 0])


INTERFACES: tuple[Interface, ...] = (
    Interface(distance_mm, _everywhere, (10.0, 66.0), 38.0, 18.0, 26.0, 0.05),
    Interface(_sheet(lambda x: 0.5 + 0.0 * x), _everywhere, (0.0, 1.5), 26.0, 10.0, 25.0, 0.05),
    Interface(_sheet(lambda x: SKIN_MM + 0.0 * x), _everywhere, (0.5, 3.0), 20.0, 6.0, 20.0, 0.05),
    Interface(lambda points: 1.2 * _LOBULES(points), _in_fat, (1.0, 13.0), 15.0, 2.0, 18.0, 0.05),
    Interface(_sheet(fascia_depth_mm), _outside_bone, (7.0, 14.0), 27.0, 8.0, 16.0, 0.04),
    Interface(_sheet(lambda x: fascia_depth_mm(x) + FASCIA_MM), _outside_bone, (8.0, 15.0), 22.0, 6.0, 16.0, 0.04),
    # the middle layer of that fascia, in front of the erector spinae
    Interface(
        _sheet(lambda x: 42.5 + 0.02 * (np.abs(x) - 22.0) ** 2), _beside(16.0), (39.0, 52.0), 22.0, 6.0, 16.0, 0.04
    ),
    Interface(_muscle_septa, _in_muscle, (10.0, 33.0), 16.0, 8.0, 18.0, 0.06),
    Interface(  # perimysium
        lambda points: 1.2 * _BUNDLES(_along_fibres(points)), _in_muscle, (9.0, 66.0), 20.0, 2.0, 13.0, 0.05
    ),
    Interface(  # endomysium
        lambda points: 0.9 * _FIBRES(_along_fibres(points)), _in_muscle, (9.0, 66.0), 9.0, -6.0, 13.0, 0.05
    ),
    Interface(vessel_distance_mm, _everywhere, (16.0, 30.0), 24.0, 8.0, 20.0, 0.04),
    Interface(_sheet(canal_roof_mm), _within(9.0), (33.0, 41.0), 20.0, 8.0, 20.0, 0.05),
    Interface(sac_distance_mm, _outside_bone, (38.0, 56.0), 22.0, 6.0, 18.0, 0.04),
    Interface(  # nerve roots
        lambda points: 1.2 * (_ROOTS(points) - 0.35),
        lambda points: np.asarray(sac_distance_mm(points) < -0.8),
        *((40.0, 54.0), 1.0, -9.0, 20.0, 0.05),
    ),
    Interface(_sheet(lambda x: BODY_DEPTH_MM + 0.0 * x), _within(17.0), (52.0, 57.0), 22.0, 8.0, 18.0, 0.05),
)


# A phantom: all that its images form from.


@dataclass(frozen=True)
class Texture:
    """Places of a tissue that are brighter or darker than others, beside speckle."""

    noise: Level  # in [-1, 1]
    strength_db: float


@dataclass(frozen=True, eq=False)
class Phantom:
    """An anatomy by functions of points. Its tissues are numbers, 0 for what lies before the skin."""

    acoustics: Sequence[Acoustics]  # by tissue
    straightened: Callable[[Floats], Floats]  # [N, 3] -> [N, 3], into the drawing
    tissue_drawn: Callable[[Floats], LabelArray]  # [N, 3] -> [N]
    interfaces: tuple[Interface, ...]
    textures: Mapping[int, Texture]  # by tissue

    def tissue_at(self, points_mm: Floats) -> LabelArray:  # [N, 3] -> [N]
        """The tissue at each point of the phantom's frame, mm. Raises InvalidArgument for another shape."""
        points_mm = np.asarray(points_mm)
        if points_mm.ndim != 2 or points_mm.shape[1] != 3:
            raise InvalidArgument(f"points_mm must be [N, 3], got {list(points_mm.shape)}", field="points_mm")
        return self.tissue_drawn(self.straightened(points_mm))

    def round_trip_db_per_mm(self) -> FloatArray:  # [tissues]
        return np.array([0.2 * FREQUENCY_MHZ * one.attenuation for one in self.acoustics])

    def backscatter_amplitudes(self) -> FloatArray:  # [tissues]
        """Amplitude of each tissue's scatterers over those of 0 dB."""
        return np.array([10.0 ** (one.backscatter_db / 20.0) for one in self.acoustics])


FASCICLES_DB = 9.0  # by which bundles of muscle fibres are brighter or darker
SPINE = Phantom(
    acoustics=[ACOUSTICS[tissue] for tissue in Tissue],
    straightened=straightened,
    tissue_drawn=tissue_drawn,
    interfaces=INTERFACES,
    textures={Tissue.MUSCLE: Texture(fascicles, FASCICLES_DB)},
)
tissue_at = SPINE.tissue_at
