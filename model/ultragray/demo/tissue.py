"""Soft tissue of the back, from the skin to the vertebral bodies: layers in mm, x to the right, y caudal, z into the body."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from ..probe import FloatArray
from . import bone
from .splats import Splats, Surface, scattered, speckle_levels, splats, spread_over

Mask = npt.NDArray[np.bool_]

HALF_WIDTH_MM = 34.0
HALF_LENGTH_MM = 52.0
DEPTH_MM = 60.0

SKIN_MM = 1.6
VESSEL_RADIUS_MM = 2.7
CANAL_HALF_WIDTH_MM = 10.5
DURA_DEPTH_MM = 40.5

TAU_SOFT = 0.97  # at an overlap of about one Gaussian, half of the pulse is left at 6 cm
TAU_INTERFACE = 0.97


def fascia_depth_mm(x: FloatArray) -> FloatArray:
    """The thoracolumbar fascia: over the two muscle bellies, and down to the spinous processes between them."""
    return 10.0 - 1.6 * np.exp(-(((np.abs(x) - 14.0) / 9.0) ** 2)) + 2.0 * np.exp(-((x / 5.0) ** 2))


def deep_fascia_depth_mm(x: FloatArray) -> FloatArray:
    """The middle layer of that fascia, in front of the erector spinae."""
    return 42.5 + 0.02 * (np.abs(x) - 22.0) ** 2


def vessel_centre_mm(y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """x and z of a vessel that winds along the erector spinae."""
    return 20.0 + 1.5 * np.sin(y / 14.0), 23.0 + 1.2 * np.sin(y / 19.0)


def inside_vessel(points: FloatArray, margin_mm: float = 0.0) -> Mask:  # [N, 3] -> [N]
    x, z = vessel_centre_mm(points[:, 1])
    return np.asarray(np.hypot(points[:, 0] - x, points[:, 2] - z) < VESSEL_RADIUS_MM + margin_mm)


def inside_canal(points: FloatArray) -> Mask:  # [N, 3] -> [N]
    x, z = np.abs(points[:, 0]), points[:, 2]
    return np.asarray((x < CANAL_HALF_WIDTH_MM) & (z > DURA_DEPTH_MM - 4.0) & (z < bone.BODY_DEPTH_MM))


def speckle(rng: np.random.Generator) -> Splats:
    """The echo of everything too small to resolve, each tissue at its own level; coarser with depth, as a beam spreads."""
    points = scattered(
        rng, (-HALF_WIDTH_MM, -HALF_LENGTH_MM, 0.0), (HALF_WIDTH_MM, HALF_LENGTH_MM, DEPTH_MM), (1.1, 4.6, 0.7)
    )
    x, z = points[:, 0], points[:, 2]
    level = np.select(
        [z < SKIN_MM, z < fascia_depth_mm(x), z < deep_fascia_depth_mm(x)],
        [0.75, 0.42, 0.43 + 0.13 * _fascicles(points)],
        0.40 + 0.08 * _fascicles(points),
    )
    level = np.where(_between_spines(points), 0.6, level)
    lateral = 0.40 + 0.006 * z
    sigmas = np.stack([lateral, np.full(len(z), 2.0), np.full(len(z), 0.26)], axis=1)
    return splats(points, sigmas, facing=speckle_levels(rng, level, len(z)), tau=TAU_SOFT)


def _fascicles(points: FloatArray) -> FloatArray:  # [N, 3] -> [N] in about [-1, 1]
    """Bundles of muscle fibres: patches of some millimetres across, drawn out along the spine."""
    x, y, z = points.T
    warped = z + 0.25 * np.abs(x) + 1.5 * np.sin(x / 3.1 + y / 31.0)
    return np.sin(warped / 0.9 + np.sin(y / 23.0)) * np.cos(x / 1.9 + 0.8 * np.sin(z / 2.7))


def _between_spines(points: FloatArray) -> Mask:
    """The interspinous ligament."""
    x, z = np.abs(points[:, 0]), points[:, 2]
    return np.asarray((x < 2.2) & (z > fascia_depth_mm(points[:, 0])) & (z < 34.0))


def skin(rng: np.random.Generator) -> Splats:
    """Entry echo and the border to the fat."""
    entry = _layer(rng, lambda x, y: 0.35 + 0.0 * x, cells=(70, 40), level=1.0, thickness_mm=0.16)
    dermis = _layer(rng, lambda x, y: SKIN_MM + 0.1 * np.sin(x / 4.0), cells=(70, 40), level=0.85, thickness_mm=0.16)
    return Splats.join(entry, dermis)


def fat_septa(rng: np.random.Generator) -> Splats:
    """Bright connective tissue between lobules of fat: broken, wavy sheets along the skin."""
    sheets = []
    for depth in (3.2, 4.9, 6.7, 8.4):
        phase = rng.uniform(0.0, 2.0 * np.pi, 3)

        def wave(x: FloatArray, y: FloatArray, depth: float = depth, phase: FloatArray = phase) -> FloatArray:
            swing = np.sin(x / 5.0 + phase[0]) + 0.7 * np.sin(x / 2.3 + y / 17.0 + phase[1]) + np.sin(y / 9.0 + phase[2])
            return depth + 0.35 * swing

        sheet = _layer(rng, wave, cells=(75, 36), level=0.8, thickness_mm=0.16)
        x, y, z = sheet.centres_mm.T
        unbroken = np.sin(x / 4.1 + 2.0 * phase[1]) + np.sin(y / 8.0 + x / 9.0 + phase[0]) > -0.3
        sheets.append(sheet.where(unbroken & (z < fascia_depth_mm(x) - 0.8)))
    return Splats.join(*sheets)


def fasciae(rng: np.random.Generator) -> Splats:
    """The two leaves of the thoracolumbar fascia, and its middle layer."""
    outer = _layer(rng, lambda x, y: fascia_depth_mm(x), cells=(110, 45), level=1.1, thickness_mm=0.17)
    inner = _layer(rng, lambda x, y: fascia_depth_mm(x) + 0.9, cells=(90, 40), level=0.95, thickness_mm=0.14)
    middle = _layer(rng, lambda x, y: deep_fascia_depth_mm(x), cells=(90, 40), level=0.95, thickness_mm=0.2)
    return Splats.join(outer, inner, middle.where(np.abs(middle.centres_mm[:, 0]) > 15.0))


def _layer(
    rng: np.random.Generator,
    depth_mm: Callable[[FloatArray, FloatArray], FloatArray],
    *,
    cells: tuple[int, int],
    level: float,
    thickness_mm: float,
) -> Splats:
    """A reflecting sheet across the whole scene."""

    def surface(u: FloatArray, v: FloatArray) -> FloatArray:
        x, y = HALF_WIDTH_MM * (2 * u - 1), HALF_LENGTH_MM * (2 * v - 1)
        return np.stack([x, y, depth_mm(x, y)], axis=1)

    return _interface(rng, surface, cells=cells, level=level, sigmas_mm=(0.55, 1.7, thickness_mm))


def _interface(
    rng: np.random.Generator,
    surface: Surface,
    *,
    cells: tuple[int, int],
    level: float,
    sigmas_mm: tuple[float, float, float],
) -> Splats:
    points, normals = spread_over(rng, surface, cells)
    points = points + normals * rng.normal(0.0, 0.5 * sigmas_mm[2], (len(points), 1))
    facing = speckle_levels(rng, level, len(points))
    return splats(points, sigmas_mm, facing=facing, edge_on=0.25 * facing, tau=TAU_INTERFACE, normals=normals)


def perimysium(rng: np.random.Generator) -> Splats:
    """Connective tissue around bundles of muscle fibres: short bright strokes across the spine, long lines along it."""
    count, beads, repeats = 1700, 6, 2
    x = rng.uniform(-HALF_WIDTH_MM, HALF_WIDTH_MM, count)
    y = rng.uniform(-HALF_LENGTH_MM, HALF_LENGTH_MM, count)
    z = rng.uniform(10.0, DEPTH_MM, count)
    side, medial = np.sign(x), np.exp(-((x / 13.0) ** 2))
    angle = side * (0.12 + 0.35 * medial) + rng.normal(0.0, 0.2, count)  # down towards the flank, more so in multifidus
    length = np.clip(rng.lognormal(1.25, 0.45, count), 1.5, 9.0)
    bend = rng.normal(0.0, 0.03, count)
    fibre = -side * 0.10 + rng.normal(0.0, 0.04, count), rng.normal(0.06, 0.04, count)  # dx/dy, dz/dy
    level = np.clip(rng.normal(0.75, 0.15, count), 0.3, 0.95)

    t = length[:, None, None] * np.linspace(-0.5, 0.5, beads)[None, :, None]
    run = 7.0 * (np.arange(repeats) - (repeats - 1) / 2)[None, None, :]
    across = x[:, None, None] + t * np.cos(angle)[:, None, None] + fibre[0][:, None, None] * run
    depth = z[:, None, None] + t * np.sin(angle)[:, None, None] + bend[:, None, None] * t**2 + fibre[1][:, None, None] * run
    along = y[:, None, None] + run + 0.0 * t
    points = np.stack([across, along, depth], axis=-1).reshape(-1, 3)
    shape = (count, beads, repeats)
    tilt = np.broadcast_to(angle[:, None, None], shape).reshape(-1)
    spacing = np.broadcast_to((length / beads)[:, None, None], shape).reshape(-1)
    brightness = np.broadcast_to(level[:, None, None], shape).reshape(-1) * rng.uniform(0.6, 1.03, len(points))
    normals = np.stack([-np.sin(tilt), np.zeros(len(tilt)), np.cos(tilt)], axis=1)
    sigmas = np.stack([0.75 * spacing, np.full(len(tilt), 3.6), np.full(len(tilt), 0.17)], axis=1)
    strokes = splats(
        points, sigmas, facing=np.clip(brightness, 0.05, 0.97), edge_on=0.5 * brightness, tau=TAU_INTERFACE, normals=normals
    )
    return strokes.where(points[:, 2] > fascia_depth_mm(points[:, 0]) + 1.5)


def muscle_septa(rng: np.random.Generator) -> Splats:
    """The sheets between multifidus, longissimus and iliocostalis."""
    sheets = []
    for side in (-1.0, 1.0):
        for top, bottom, curve in ((6.0, 16.0, 2.0), (20.0, 27.0, -2.0)):

            def surface(
                u: FloatArray, v: FloatArray, side: float = side, top: float = top, bottom: float = bottom, c: float = curve
            ) -> FloatArray:
                y = HALF_LENGTH_MM * (2 * v - 1)
                x = top + (bottom - top) * u + c * np.sin(np.pi * u) + 0.4 * np.sin(14.0 * u + y / 12.0)
                return np.stack([side * x, y, 10.5 + 24.0 * u], axis=1)

            sheets.append(_interface(rng, surface, cells=(36, 36), level=0.8, sigmas_mm=(0.5, 1.9, 0.3)))
    return Splats.join(*sheets)


def vessel(rng: np.random.Generator) -> Splats:
    """The wall of a vessel; nothing inside echoes."""

    def surface(u: FloatArray, v: FloatArray) -> FloatArray:
        y = HALF_LENGTH_MM * (2 * v - 1)
        x, z = vessel_centre_mm(y)
        radius = VESSEL_RADIUS_MM
        return np.stack([x + radius * np.cos(2 * np.pi * u), y, z + radius * np.sin(2 * np.pi * u)], axis=1)

    return _interface(rng, surface, cells=(36, 44), level=1.05, sigmas_mm=(0.4, 1.6, 0.17))


def ligaments(rng: np.random.Generator) -> Splats:
    """What shows between the laminae: the yellow ligament, the dura, and the front of the canal."""

    def strip(half_width: float, depth: float, sag: float) -> Surface:
        def surface(u: FloatArray, v: FloatArray) -> FloatArray:
            x, y = half_width * (2 * u - 1), HALF_LENGTH_MM * (2 * v - 1)
            return np.stack([x, y, depth + sag * np.abs(x)], axis=1)

        return surface

    flavum = _interface(rng, strip(9.0, 36.0, 0.12), cells=(24, 50), level=1.0, sigmas_mm=(0.6, 1.3, 0.35))
    dura = _interface(rng, strip(8.0, DURA_DEPTH_MM, 0.10), cells=(22, 50), level=1.05, sigmas_mm=(0.6, 1.3, 0.17))
    front = _interface(
        rng, strip(CANAL_HALF_WIDTH_MM, bone.BODY_DEPTH_MM, 0.0), cells=(28, 50), level=1.1, sigmas_mm=(0.6, 1.3, 0.3)
    )
    return Splats.join(flavum, dura, front)


def outside_fluid(gaussians: Splats) -> Splats:
    """Blood and cerebrospinal fluid have no echo."""
    points = gaussians.centres_mm
    return gaussians.where(~inside_vessel(points, margin_mm=0.3) & ~inside_canal(points))
