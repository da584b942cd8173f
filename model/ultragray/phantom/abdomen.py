"""The second phantom: the right upper abdomen, with liver, vessels, gallbladder, kidney, ribs and bowel gas.

Frame, mm, as the spine's: x to the patient's left, y caudal, z from the skin into the body. Tissues have the acoustics
of `ultragray.scene.tissues`, surfaces reflect by the step of the impedance there.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ultragray.geometry.probe import LinearProbe
from ultragray.phantom.anatomy import (
    Acoustics,
    Floats,
    Interface,
    LabelArray,
    LatticeNoise,
    Level,
    Phantom,
    Texture,
    Triple,
)
from ultragray.scene.tissues import TISSUES, reflection_db

ABDOMEN_PROBE = LinearProbe(width_mm=80.0, near_mm=0.0, far_mm=100.0)
NAMES = (  # of tissues, from 1
    *("skin", "subcutaneous fat", "muscle", "fat", "liver", "blood", "connective tissue", "cyst"),
    *("kidney cortex", "kidney medulla", "renal sinus", "bone", "gas"),
)
_SKIN, _UNDER_SKIN, _MUSCLE, _FAT, _LIVER, _BLOOD, _WALL, _BILE, _CORTEX, _MEDULLA, _SINUS, _BONE, _GAS = range(1, 14)
BODY_NAMES = {_FAT: "retroperitoneum", _WALL: "vessel wall", _BILE: "gallbladder", _BLOOD: "vessel"}
SKIN_MM, FAT_MM, WALL_MM = 2.0, 10.0, 17.0  # depths at which the layers of the abdominal wall end
WALL_THICKNESS_MM = 0.9  # of portal veins and of the gallbladder


def _ellipsoid(centre: Triple, radii: Triple) -> Level:
    middle, half = np.array(centre, np.float32), np.array(radii, np.float32)

    def level(points: Floats) -> Floats:
        scaled = (points - middle) / half
        radius = np.linalg.norm(scaled, axis=1)
        steepness = np.linalg.norm(scaled / half, axis=1)
        levels: Floats = (radius - 1.0) * radius / np.maximum(steepness, 1e-6)
        return levels

    return level


def _tube(path: list[Triple], radius: float) -> Level:
    places = np.array(path, np.float32)

    def level(points: Floats) -> Floats:
        nearest = np.full(len(points), np.inf, np.float32)
        for start, way in zip(places[:-1], np.diff(places, axis=0), strict=True):
            along = np.clip((points - start) @ way / (way @ way), 0.0, 1.0)
            nearest = np.minimum(nearest, np.linalg.norm(points - start - along[:, None] * way, axis=1))
        levels: Floats = nearest - np.float32(radius)
        return levels

    return level


def _first(levels: list[Level]) -> Level:
    return lambda points: np.min([level(points) for level in levels], axis=0)


def _sheet(depth_mm: float) -> Level:
    return lambda points: points[:, 2] - np.float32(depth_mm)


liver = _ellipsoid((-14.0, 0.0, 47.0), (58.0, 90.0, 33.0))
portal = _first(
    [
        _tube([(-40.0, -8.0, 60.0), (-14.0, 2.0, 52.0), (6.0, 10.0, 55.0)], 4.6),
        _tube([(-14.0, 2.0, 52.0), (-22.0, 26.0, 42.0), (-34.0, 44.0, 36.0)], 3.2),
        _tube([(-14.0, 2.0, 52.0), (-18.0, -26.0, 44.0), (-30.0, -48.0, 36.0)], 3.4),
    ]
)
hepatic = _first(
    [
        _tube([(-46.0, 20.0, 32.0), (-20.0, -14.0, 34.0), (4.0, -40.0, 44.0)], 3.0),
        _tube([(-34.0, -50.0, 56.0), (-6.0, -20.0, 62.0), (8.0, 0.0, 70.0)], 3.4),
    ]
)
gallbladder = _ellipsoid((15.0, 8.0, 36.0), (9.0, 17.0, 9.5))
kidney = _ellipsoid((6.0, 22.0, 80.0), (25.0, 50.0, 19.0))
sinus = _ellipsoid((8.0, 22.0, 80.0), (12.0, 30.0, 7.0))
gas = _ellipsoid((36.0, 6.0, 33.0), (11.0, 34.0, 9.0))
bowel = _ellipsoid((36.0, 6.0, 33.0), (13.0, 36.0, 11.0))
ribs = _first(
    [
        _tube([(-31.0, -60.0, 12.5), (-27.0, 4.0, 13.5)], 4.2),
        _tube([(-9.0, -60.0, 12.5), (-4.0, -6.0, 13.5)], 4.2),
    ]
)


def _pyramids(points: Floats) -> Floats:
    """Negative in the pyramids of the kidney: cones about its sinus, wide at the cortex."""
    x, y, z = (points - np.array([7.0, 22.0, 80.0], np.float32)).T
    around = np.cos(5.0 * np.arctan2(z / 19.0, x / 25.0)) * np.cos(np.pi * y / 15.0)
    depth = np.abs(kidney(points) + 8.5) - 4.0  # between the sinus and the cortex
    levels: Floats = np.maximum(depth, 3.0 * (0.1 - around))
    return levels


def straightened(points: Floats) -> Floats:  # [N, 3] -> [N, 3]
    """Takes small bends out, which leave the skin as it is."""
    x, y, z = points.T
    rise = np.clip(z / 10.0, 0.0, 1.0)
    sideways = 1.2 * np.sin(y / 23.0 + 0.5) + 0.5 * np.sin(z / 9.0 + x / 13.0)
    ripple = 0.8 * np.sin(x / 14.0 + y / 21.0) + 0.3 * np.sin(x / 4.1 + y / 8.0)
    return np.stack([x - rise * sideways, y, z - rise * ripple], axis=1)


def tissue_drawn(points: Floats) -> LabelArray:  # [N, 3] -> [N]
    z = points[:, 2]
    inner = z > WALL_MM
    in_kidney, in_liver = kidney(points) < 0.0, (liver(points) < 0.0) & inner
    portal_mm, gallbladder_mm = portal(points), gallbladder(points)
    return np.select(
        [
            z < 0.0,
            z < SKIN_MM,
            ribs(points) < 0.0,
            z < FAT_MM,
            ~inner,
            gas(points) < 0.0,
            bowel(points) < 0.0,
            gallbladder_mm < 0.0,
            gallbladder_mm < WALL_THICKNESS_MM,
            in_kidney & (sinus(points) < 0.0),
            in_kidney & (_pyramids(points) < 0.0),
            in_kidney,
            in_liver & (portal_mm < 0.0),
            in_liver & (portal_mm < WALL_THICKNESS_MM),
            in_liver & (hepatic(points) < 0.0),
            in_liver,
        ],
        [
            *(0, _SKIN, _BONE, _UNDER_SKIN, _MUSCLE, _GAS, _MUSCLE, _BILE, _WALL),
            *(_SINUS, _MEDULLA, _CORTEX, _BLOOD, _WALL, _BLOOD, _LIVER),
        ],
        _FAT,
    ).astype(np.uint8)


def _between(
    level: Level, first: int, second: int, depths_mm: tuple[float, float], lobe_deg: float = 22.0
) -> Interface:
    """A surface between two tissues."""
    specular = reflection_db(*(TISSUES[NAMES[tissue - 1]].impedance for tissue in (first, second)))

    def present(points: Floats) -> npt.NDArray[np.bool_]:
        step = np.array([0.0, 0.0, 1.2], np.float32)
        above, below = tissue_drawn(points - step), tissue_drawn(points + step)
        if second in (_BONE, _GAS):  # from which no sound comes back to its far side
            return np.asarray((above != second) & (below == second))
        return np.isin(above, (first, second)) | np.isin(below, (first, second))

    return Interface(level, present, depths_mm, specular, specular - 18.0, lobe_deg, 0.05)


INTERFACES = (
    _between(_sheet(SKIN_MM), _SKIN, _UNDER_SKIN, (1.0, 3.0)),
    _between(_sheet(FAT_MM), _UNDER_SKIN, _MUSCLE, (7.0, 13.0)),
    _between(_sheet(WALL_MM), _MUSCLE, _FAT, (14.0, 20.0)),
    _between(ribs, _MUSCLE, _BONE, (5.0, 22.0), 30.0),
    _between(gas, _MUSCLE, _GAS, (20.0, 46.0), 40.0),
    _between(gallbladder, _WALL, _BILE, (22.0, 50.0)),
    _between(portal, _WALL, _BLOOD, (25.0, 75.0)),
    _between(liver, _LIVER, _FAT, (15.0, 85.0)),
    _between(kidney, _FAT, _CORTEX, (55.0, 105.0)),
)
_LUMPS = LatticeNoise(31, (3.0, 3.0, 2.0))
_FIBRES = LatticeNoise(32, (2.5, 12.0, 0.8))
ABDOMEN = Phantom(
    acoustics=[
        Acoustics(0.0, -np.inf),
        *(Acoustics(TISSUES[name].attenuation, TISSUES[name].echo_db) for name in NAMES),
    ],
    straightened=straightened,
    tissue_drawn=tissue_drawn,
    interfaces=INTERFACES,
    textures={
        number: Texture(_FIBRES if number in (_MUSCLE, _UNDER_SKIN) else _LUMPS, 2.0 * TISSUES[name].texture_db)
        for number, name in enumerate(NAMES, 1)
    },
)
