"""Soft tissue of the back, from the skin to the vertebral bodies, in the frame of the demo scene, mm."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from ..probe import FloatArray
from . import bone
from .splats import Splats, Surface, scattered, speckle_levels, spread_over

HALF_WIDTH_MM = 33.0
HALF_LENGTH_MM = 45.0
DEPTH_MM = 62.0

SKIN_MM = 1.7
VESSEL_RADIUS_MM = 2.7
SAC_DEPTH_MM, SAC_HALF_WIDTH_MM, SAC_HALF_DEPTH_MM = 47.0, 8.5, 6.2  # the dural sac, an elliptic tube

TAU_SOFT = 0.977  # at an overlap of about one Gaussian, three quarters of the pulse are left at 6 cm
TAU_INTERFACE = 0.97


def fascia_depth_mm(x: FloatArray) -> FloatArray:
    """The thoracolumbar fascia: over the two muscle bellies, down to the spinous processes between them."""
    return 10.0 - 1.6 * np.exp(-(((np.abs(x) - 14.0) / 9.0) ** 2)) + 2.0 * np.exp(-((x / 5.0) ** 2))


def deep_fascia_depth_mm(x: FloatArray) -> FloatArray:
    """The middle layer of that fascia, in front of the erector spinae."""
    return 42.5 + 0.02 * (np.abs(x) - 22.0) ** 2


def vessel_centre_mm(y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """x and z of a vessel that winds along the erector spinae."""
    return 20.0 + 1.5 * np.sin(y / 14.0), 23.0 + 1.2 * np.sin(y / 19.0)


def outside_fluid(gaussians: Splats) -> Splats:
    """Blood gives no echo, cerebrospinal fluid next to none."""
    x, y, z = gaussians.centres_mm.T
    vessel_x, vessel_z = vessel_centre_mm(y)
    in_vessel = np.hypot(x - vessel_x, z - vessel_z) < VESSEL_RADIUS_MM + 0.3
    return gaussians.where(~in_vessel & (_sac_radius(gaussians.centres_mm) > 1.05))


def _sac_radius(points: FloatArray) -> FloatArray:  # [N, 3] -> [N]
    """Distance from the axis of the dural sac, 1 on its wall."""
    radius: FloatArray = np.hypot(points[:, 0] / SAC_HALF_WIDTH_MM, (points[:, 2] - SAC_DEPTH_MM) / SAC_HALF_DEPTH_MM)
    return radius


def speckle(rng: np.random.Generator) -> Splats:
    """The echo of all that is too small to resolve, at each tissue's level; coarser with depth."""
    low, high = (-HALF_WIDTH_MM, -HALF_LENGTH_MM, 0.0), (HALF_WIDTH_MM, HALF_LENGTH_MM, DEPTH_MM)
    points = scattered(rng, low, high, (1.2, 3.8, 0.76))
    x, z = points[:, 0], points[:, 2]
    level = np.select(
        [z < SKIN_MM, z < fascia_depth_mm(x), (np.abs(x) < 2.5) & (z < 33.0), z < deep_fascia_depth_mm(x)],
        [1.0, 0.42, 0.60, 0.45 + 0.13 * _fascicles(points)],  # skin, fat, interspinous ligament, muscle
        0.40 + 0.10 * _fascicles(points),
    )
    sigmas = np.stack([0.40 + 0.006 * z, 1.1 + 0.012 * z, np.full(len(z), 0.26)], axis=1)
    return Splats.of(points, sigmas, facing=speckle_levels(rng, level, len(z)), tau=TAU_SOFT)


def _fascicles(points: FloatArray) -> FloatArray:  # [N, 3] -> [N] in [-1, 1]
    """Bundles of muscle fibres: patches of some millimetres, drawn out along the spine."""
    x, y, z = points.T
    warped = z + 0.25 * np.abs(x) + 1.5 * np.sin(x / 3.1 + y / 31.0)
    bundles: FloatArray = np.sin(warped / 1.3 + np.sin(y / 23.0)) * np.cos(x / 2.3 + 0.8 * np.sin(z / 2.7))
    return bundles


def cauda_equina(rng: np.random.Generator) -> Splats:
    """Nerve roots that float in the dural sac."""
    points = scattered(rng, (-8.0, -HALF_LENGTH_MM, 41.0), (8.0, HALF_LENGTH_MM, 53.0), (2.0, 5.0, 1.6))
    points = points[_sac_radius(points) < 0.85]
    return Splats.of(points, (0.6, 2.5, 0.3), facing=speckle_levels(rng, 0.2, len(points)), tau=TAU_SOFT)


def skin(rng: np.random.Generator) -> Splats:
    """The entry echo and the border to the fat."""
    entry = _layer(rng, lambda x, y: 0.4 + 0.0 * x, cells=(70, 40), level=1.1, edge_on=0.95, thickness_mm=0.2)
    dermis = _layer(
        rng,
        lambda x, y: SKIN_MM + 0.1 * np.sin(x / 4.0),
        cells=(60, 36),
        level=0.95,
        edge_on=0.9,
        thickness_mm=0.16,
    )
    return Splats.join(entry, dermis)


def fat_septa(rng: np.random.Generator) -> Splats:
    """Bright connective tissue between lobules of fat: broken, wavy sheets along the skin."""
    sheets = []
    for depth in (3.1, 4.4, 5.7, 7.0, 8.2):
        sheet = _layer(
            rng,
            partial(_wave, depth, rng.uniform(0.0, 2.0 * np.pi, 3)),
            cells=(80, 36),
            level=1.0,
            edge_on=0.8,
            thickness_mm=0.15,
        )
        x, y, z = sheet.centres_mm.T
        start = rng.uniform(0.0, 2.0 * np.pi, 2)
        unbroken = np.sin(x / 3.7 + start[0]) + np.sin(y / 8.0 + x / 9.0 + start[1]) > 0.0
        sheets.append(sheet.where(unbroken & (z < fascia_depth_mm(x) - 0.7)))
    return Splats.join(*sheets)


def _wave(depth: float, phase: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    swing: FloatArray = np.sin(x / 4.0 + phase[0]) + 0.8 * np.sin(x / 2.1 + y / 17.0 + phase[1])
    swing += np.sin(y / 9.0 + phase[2])
    return depth + 0.4 * swing


def fasciae(rng: np.random.Generator) -> Splats:
    """The two leaves of the thoracolumbar fascia, and its middle layer."""
    outer = _layer(rng, lambda x, y: fascia_depth_mm(x), cells=(105, 42), level=1.2, edge_on=0.7, thickness_mm=0.19)
    inner = _layer(
        rng, lambda x, y: fascia_depth_mm(x) + 1.0, cells=(85, 36), level=1.0, edge_on=0.6, thickness_mm=0.13
    )
    middle = _layer(rng, lambda x, y: deep_fascia_depth_mm(x), cells=(85, 36), level=1.0, edge_on=0.6, thickness_mm=0.2)
    return Splats.join(outer, inner, middle.where(np.abs(middle.centres_mm[:, 0]) > 15.0))


def _layer(
    rng: np.random.Generator,
    depth_mm: Callable[[FloatArray, FloatArray], FloatArray],  # of x and y
    *,
    cells: tuple[int, int],
    level: float,
    edge_on: float,
    thickness_mm: float,
) -> Splats:
    """A sheet across the whole scene."""

    def surface(u: FloatArray, v: FloatArray) -> FloatArray:
        x, y = HALF_WIDTH_MM * (2 * u - 1), _along(v)
        return np.stack([x, y, depth_mm(x, y)], axis=1)

    return _interface(rng, surface, cells=cells, level=level, edge_on=edge_on, sigmas_mm=(0.55, 1.6, thickness_mm))


def _along(v: FloatArray) -> FloatArray:
    return HALF_LENGTH_MM * (2 * v - 1)


def _interface(
    rng: np.random.Generator,
    surface: Surface,
    *,
    cells: tuple[int, int],
    level: float,
    edge_on: float,  # share of the level that is left where it is seen edge on
    sigmas_mm: tuple[float, float, float],
) -> Splats:
    points, normals = spread_over(rng, surface, cells)
    points = points + normals * rng.normal(0.0, 0.4 * sigmas_mm[2], (len(points), 1))
    facing = speckle_levels(rng, level, len(points))
    return Splats.of(points, sigmas_mm, facing=facing, edge_on=edge_on * facing, tau=TAU_INTERFACE, normals=normals)


def perimysium(rng: np.random.Generator) -> Splats:
    """Connective tissue around muscle fibres: short strokes across the spine, long lines along it."""
    strokes, beads, repeats = 1900, 5, 2
    shape = (strokes, beads, repeats)
    one = (strokes, 1, 1)
    x = rng.uniform(-HALF_WIDTH_MM, HALF_WIDTH_MM, one)
    y = rng.uniform(-HALF_LENGTH_MM, HALF_LENGTH_MM, one)
    z = rng.uniform(10.0, DEPTH_MM, one)
    side, medial = np.sign(x), np.exp(-((x / 13.0) ** 2))
    slope = side * (0.12 + 0.35 * medial)  # down to the flank, most in multifidus
    angle = slope + rng.normal(0.0, 0.18, one)
    length = np.clip(rng.lognormal(1.1, 0.5, one), 1.2, 7.0)
    level = rng.uniform(0.55, 1.1, one)

    t = length * np.linspace(-0.5, 0.5, beads)[:, None]
    run = 7.0 * (np.arange(repeats) - (repeats - 1) / 2)  # along the fibres, which lean outwards and down
    bend = rng.normal(0.0, 0.03, one) * t**2
    across = x + t * np.cos(angle) + (rng.normal(0.0, 0.04, one) - 0.10 * side) * run
    depth = z + t * np.sin(angle) + bend + rng.normal(0.06, 0.04, one) * run
    points = np.stack(np.broadcast_arrays(across, y + run, depth), axis=-1).reshape(-1, 3)

    def each(value: FloatArray) -> FloatArray:
        return np.broadcast_to(value, shape).reshape(-1)

    tilt = each(angle)
    normals = np.stack([-np.sin(tilt), np.zeros(len(tilt)), np.cos(tilt)], axis=1)
    reach = each(0.2 + 0.65 * length / beads)
    sigmas = np.stack([reach, np.full(len(reach), 3.6), np.full(len(reach), 0.18)], axis=1)
    facing = speckle_levels(rng, each(level), len(points))
    lines = Splats.of(points, sigmas, facing=facing, edge_on=0.6 * facing, tau=TAU_INTERFACE, normals=normals)
    return lines.where(points[:, 2] > fascia_depth_mm(points[:, 0]) + 1.5)


def muscle_septa(rng: np.random.Generator) -> Splats:
    """The sheets between multifidus, longissimus and iliocostalis."""

    def surface(outward: float, top: float, bottom: float, u: FloatArray, v: FloatArray) -> FloatArray:
        y = _along(v)
        x = top + (bottom - top) * u + 0.35 * np.sin(14.0 * u + y / 12.0)
        return np.stack([outward * x, y, 11.0 + 20.0 * u], axis=1)

    return Splats.join(
        *(
            _interface(
                rng,
                partial(surface, outward, top, bottom),
                cells=(30, 30),
                level=0.6,
                edge_on=0.8,
                sigmas_mm=(0.45, 1.9, 0.3),
            )
            for outward in (-1.0, 1.0)
            for top, bottom in ((5.0, 15.0), (18.0, 27.0))
        )
    )


def vessel(rng: np.random.Generator) -> Splats:
    """The wall of a vessel, bright where the beam meets it at right angles."""

    def surface(u: FloatArray, v: FloatArray) -> FloatArray:
        y, angle = _along(v), 2 * np.pi * u
        x, z = vessel_centre_mm(y)
        return np.stack([x + VESSEL_RADIUS_MM * np.cos(angle), y, z + VESSEL_RADIUS_MM * np.sin(angle)], axis=1)

    return _interface(rng, surface, cells=(36, 40), level=1.1, edge_on=0.25, sigmas_mm=(0.4, 1.6, 0.2))


def ligaments(rng: np.random.Generator) -> Splats:
    """What shows between the laminae: the yellow ligament, the dural sac, and the front of the canal."""

    def roof(u: FloatArray, v: FloatArray) -> FloatArray:
        x = 9.0 * (2 * u - 1)
        return np.stack([x, _along(v), 35.5 + 0.28 * np.sqrt(x * x + 4.0)], axis=1)

    def sac(u: FloatArray, v: FloatArray) -> FloatArray:
        angle = 2 * np.pi * u
        x, z = SAC_HALF_WIDTH_MM * np.cos(angle), SAC_DEPTH_MM + SAC_HALF_DEPTH_MM * np.sin(angle)
        return np.stack([x, _along(v), z], axis=1)

    def front(u: FloatArray, v: FloatArray) -> FloatArray:
        x = 13.0 * (2 * u - 1)
        return np.stack([x, _along(v), bone.BODY_DEPTH_MM + 0.6 - 0.006 * x * x], axis=1)

    flavum = _interface(rng, roof, cells=(26, 42), level=1.0, edge_on=0.6, sigmas_mm=(0.6, 1.6, 0.5))
    dura = _interface(rng, sac, cells=(56, 42), level=1.05, edge_on=0.2, sigmas_mm=(0.5, 1.6, 0.2))
    anterior = _interface(rng, front, cells=(36, 42), level=1.2, edge_on=0.6, sigmas_mm=(0.6, 1.6, 0.35))
    return Splats.join(flavum, dura, anterior)
