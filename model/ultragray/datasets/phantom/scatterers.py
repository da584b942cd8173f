"""The scatterers of the phantom: points at random in the tissue and on its interfaces, made block by block.

A block's scatterers follow from its place alone, so every frame of every sweep sees the same ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from ultragray.datasets.phantom import anatomy
from ultragray.datasets.phantom.acoustics import backscatter_amplitudes
from ultragray.datasets.phantom.bone import Floats
from ultragray.datasets.phantom.interfaces import INTERFACES, Interface, fascicles
from ultragray.probe import FloatArray

Float32Array = npt.NDArray[np.float32]

BLOCK_MM = 8.0
PER_MM3 = 8.0  # about five in a cell of the beam's resolution: speckle is fully developed
LAST_BLOCKS = 256  # kept for calls of one frame each, about 20 MB: neighbouring frames share most of their blocks
BAND_MM = 0.4  # scatterers this near to an interface are repeated on it
FASCICLES_DB = 9.0  # by which bundles of muscle fibres are brighter or darker
_SEED = 20261121
_OFFSET = 1 << 20  # seeds are not negative
_GRADIENT_STEP_MM = 1e-2


@dataclass(frozen=True)
class Scatterers:
    """The scatterers of a region: in tissue, the same from everywhere, and on interfaces, brightest face on."""

    points_mm: Float32Array  # [N, 3]
    amplitudes: Float32Array  # [N]
    surface_mm: Float32Array  # [M, 3]
    normals: Float32Array  # [M, 3] unit
    specular: Float32Array  # [M] seen along the normal, added to
    diffuse: Float32Array  # [M]
    lobe_rad: Float32Array  # [M] standard deviation of the specular lobe

    def between(self, pose: FloatArray, low_mm: float, high_mm: float) -> Scatterers:
        """Those between two elevations in the frame of a pose."""
        axis = pose[:3, 1].astype(np.float32)
        zero = float(pose[:3, 3] @ pose[:3, 1])
        in_tissue, on_surface = (self.points_mm @ axis - zero, self.surface_mm @ axis - zero)
        inside = np.flatnonzero((in_tissue > low_mm) & (in_tissue < high_mm))
        facing = np.flatnonzero((on_surface > low_mm) & (on_surface < high_mm))
        return Scatterers(
            self.points_mm[inside],
            self.amplitudes[inside],
            self.surface_mm[facing],
            self.normals[facing],
            self.specular[facing],
            self.diffuse[facing],
            self.lobe_rad[facing],
        )

    @classmethod
    def join(cls, parts: list[Scatterers]) -> Scatterers:
        """All scatterers of several blocks."""
        names = cls.__dataclass_fields__
        return cls(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


_NUMBERS, _VECTORS = np.zeros(0, dtype=np.float32), np.zeros((0, 3), dtype=np.float32)
NOTHING = Scatterers(_VECTORS, _NUMBERS, _VECTORS, _VECTORS, _NUMBERS, _NUMBERS, _NUMBERS)


class ScattererField:
    """The scatterers of the phantom, each block made when a frame first needs it."""

    def __init__(self) -> None:
        self._blocks: dict[tuple[int, int, int], Scatterers] = {}

    def slice(self, pose: FloatArray, low_mm: FloatArray, high_mm: FloatArray) -> Scatterers:
        """The scatterers between two elevations, in the blocks that touch a box [3], [3] of the frame of a pose."""
        blocks = (self._block(index) for index in _blocks_near(pose, low_mm, high_mm))
        return Scatterers.join([NOTHING, *(block.between(pose, low_mm[1], high_mm[1]) for block in blocks)])

    def _block(self, index: tuple[int, int, int]) -> Scatterers:
        if index not in self._blocks:
            self._blocks[index] = _made(index)
        return self._blocks[index]


def _blocks_near(pose: FloatArray, low_mm: FloatArray, high_mm: FloatArray) -> Iterator[tuple[int, int, int]]:
    rotation, origin = pose[:3, :3], pose[:3, 3]
    corners = np.stack(np.meshgrid(*zip(low_mm, high_mm, strict=True), indexing="ij"), axis=-1).reshape(-1, 3)
    corners = corners @ rotation.T + origin
    first, last = (np.floor(edge / BLOCK_MM).astype(int) for edge in (corners.min(axis=0), corners.max(axis=0)))
    ranges = [np.arange(a, b + 1) for a, b in zip(first, last, strict=True)]
    indices = np.stack(np.meshgrid(*ranges, indexing="ij"), axis=-1).reshape(-1, 3)
    middles = ((indices + 0.5) * BLOCK_MM - origin) @ rotation
    reach = 0.5 * BLOCK_MM * np.abs(rotation).sum(axis=0)
    touching = ((middles > low_mm - reach) & (middles < high_mm + reach)).all(axis=1)
    return ((int(i), int(j), int(k)) for i, j, k in indices[touching & (indices[:, 2] >= 0)])


@lru_cache(maxsize=LAST_BLOCKS)
def _made(index: tuple[int, int, int]) -> Scatterers:
    rng = np.random.default_rng([_SEED, *(i + _OFFSET for i in index)])
    count = round(PER_MM3 * BLOCK_MM**3)
    points: Float32Array = ((np.asarray(index) + rng.random((count, 3))) * BLOCK_MM).astype(np.float32)
    drawn = anatomy.straightened(points)
    labels = anatomy.tissue_drawn(drawn)
    amplitudes = backscatter_amplitudes()[labels] * rng.normal(0.0, 1.0, count)
    muscle = labels == anatomy.Tissue.MUSCLE
    amplitudes[muscle] *= 10.0 ** (FASCICLES_DB / 20.0 * fascicles(drawn[muscle]))
    parts = [_on(interface, rng, points, drawn) for interface in INTERFACES]
    surface, normals, specular, diffuse, lobe = (np.concatenate(column) for column in zip(*parts, strict=True))
    heard = amplitudes != 0.0
    return Scatterers(
        *(
            np.asarray(values, dtype=np.float32)
            for values in (points[heard], amplitudes[heard], surface, normals, specular, diffuse, lobe)
        )
    )


def _on(
    interface: Interface, rng: np.random.Generator, points: Floats, drawn: Floats
) -> tuple[Floats, ...]:  # [M, 3], [M, 3], [M], [M], [M]
    """The scatterers near an interface moved onto it, with its normals there and their amplitudes."""
    low, high = interface.depths_mm
    near = np.flatnonzero((points[:, 2] > low) & (points[:, 2] < high))
    level = interface.level(drawn[near])
    close = np.abs(level) < 2.0 * BAND_MM  # the function is only roughly a distance
    near, level = near[close], level[close]
    gradient = _gradient(interface, points[near], level)
    steepness = np.maximum(np.linalg.norm(gradient, axis=1), 1e-6)
    kept = np.abs(level) < BAND_MM * steepness
    kept[kept] = interface.present(drawn[near[kept]])
    near, level, gradient, steepness = near[kept], level[kept], gradient[kept], steepness[kept]
    normals = gradient / steepness[:, None]
    shift = interface.roughness_mm * rng.normal(0.0, 1.0, len(near)) - level / steepness
    strength = rng.normal(1.0, 0.3, len(near))
    return (
        points[near] + shift[:, None] * normals,
        normals,
        strength * 10.0 ** (interface.specular_db / 20.0),
        strength * 10.0 ** (interface.diffuse_db / 20.0),
        np.full(len(near), np.radians(interface.lobe_deg)),
    )


def _gradient(interface: Interface, points: Floats, level: Floats) -> Floats:  # [M, 3], [M] -> [M, 3]
    """Of the interface's function, in the phantom's frame."""
    shifted = (points + _GRADIENT_STEP_MM * axis for axis in np.eye(3, dtype=np.float32))
    steps = [interface.level(anatomy.straightened(there)) - level for there in shifted]
    return np.stack(steps, axis=1) / _GRADIENT_STEP_MM
