"""Fields of a scene at points: sums over its Gaussians, without probe, beam or shadow.

At a point p, with w = min(0.999, exp(−½·(p−μ)ᵀA(p−μ))) of each Gaussian, left out where below 1/255, and S = Σ w:

    coverage     1 − exp(−S)
    echo         (1 − exp(−S)) · Σ I·w / (S + 1e-8), I without its part that depends on the direction of view
    attenuation  Σ (1 − τ)·w, per mm: −d ln T / ds of a beam that passes, where the Gaussians are thin
    labels       the label with the largest sum of w, 0 where none reaches 1/255

These are the sums of docs/physics.md §3, but for tails: a renderer also counts w below 1/255 on scan lines where the
same Gaussian absorbs more than that. They are made in float64, and in an order that does not depend on threads.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from ultragray.backends.labels import MIN_WEIGHT_SUM
from ultragray.backends.reference import MAX_WEIGHT, MIN_WEIGHT, intensity, inverse_root_covariance
from ultragray.limits import UNLIMITED, Limits
from ultragray.probe import FloatArray
from ultragray.scene import GaussianScene
from ultragray.volumes.grid import VolumeGrid
from ultragray.volumes.names import check_field

POINTS_AT_ONCE = 1 << 21  # voxels of a slab, and pairs of voxel and Gaussian: some 250 MB
_RADIUS = math.sqrt(-2.0 * math.log(MIN_WEIGHT))

IndexArray = npt.NDArray[np.int64]


@dataclass(frozen=True)
class _Ellipsoids:
    """The Gaussians of a scene in steps of a grid."""

    means: FloatArray  # [N, 3] voxels
    roots: FloatArray  # [N, 3, 3]: |L·(index − mean)|² is m²
    reach: FloatArray  # [N, 3] voxels from the mean at which w falls below 1/255, along each axis
    intensities: FloatArray  # [N]
    absorbed: FloatArray  # [N] 1 − τ, per mm
    labels: IndexArray  # [N]

    @classmethod
    def of(cls, scene: GaussianScene, grid: VolumeGrid) -> _Ellipsoids:
        with torch.no_grad():
            exact = scene.to("cpu").to(torch.float64)
            steps = torch.from_numpy(np.ascontiguousarray(grid.axes.T * grid.spacing_mm / 10.0))  # cm a voxel
            roots = inverse_root_covariance(exact, steps).numpy()
            intensities = intensity(exact, exact.means).numpy()  # seen from its own mean: no direction
            absorbed = torch.sigmoid(-exact.transmittances).numpy() / 10.0
            means_mm = exact.means.numpy() * 10.0 + np.asarray(scene.info.centre_mm)
        labels = np.zeros(len(means_mm), np.int64) if exact.labels is None else exact.labels.numpy().astype(np.int64)
        means = (means_mm - grid.origin_mm) @ grid.axes.T / grid.spacing_mm
        reach = _RADIUS * np.linalg.norm(np.linalg.inv(roots), axis=2)
        return cls(means, roots, reach, intensities, absorbed, labels)


def sample_volume(scene: GaussianScene, field: str, grid: VolumeGrid) -> Iterator[npt.NDArray[np.generic]]:
    """A field in slabs [k, J, I] that follow each other along the grid's last axis: float32, labels uint8.

    What is held at once does not grow with the grid. Raises InvalidArgument for a field that is none of VOLUME_FIELDS,
    and for labels of a scene that has none.
    """
    check_field(field, has_labels=scene.labels is not None)
    return _slabs(scene, field, grid, UNLIMITED)


def sample_slice(
    scene: GaussianScene, field: str, grid: VolumeGrid, limits: Limits = UNLIMITED
) -> npt.NDArray[np.generic]:  # [J, I]
    """A field on a plane (`VolumeGrid.on_plane`). Raises what `sample_volume` raises, and FrameTooCostly and GivenUp by
    `limits`: footprint pixels are those of the boxes around Gaussians."""
    check_field(field, has_labels=scene.labels is not None)
    layer: npt.NDArray[np.generic] = np.concatenate(list(_slabs(scene, field, grid, limits)))[0]
    return layer


def _slabs(scene: GaussianScene, field: str, grid: VolumeGrid, limits: Limits) -> Iterator[npt.NDArray[np.generic]]:
    ellipsoids = _Ellipsoids.of(scene, grid)
    columns, rows, depth = grid.shape
    thickness = max(1, POINTS_AT_ONCE // (columns * rows))
    for first in range(0, depth, thickness):
        slab = _Slab(ellipsoids, (columns, rows, min(thickness, depth - first)), first, limits)
        limits.check_costs([slab.footprint])
        yield slab.values(field).reshape(slab.shape[::-1])


class _Slab:
    """The voxels of a grid from one number of its last axis on."""

    def __init__(self, ellipsoids: _Ellipsoids, shape: tuple[int, int, int], first: int, limits: Limits) -> None:
        self.ellipsoids, self.shape, self._limits = ellipsoids, shape, limits
        self._offset = np.array([0, 0, first])
        means = ellipsoids.means - self._offset
        self._low = np.maximum(np.ceil(means - ellipsoids.reach), 0).astype(np.int64)
        self._high = np.minimum(np.floor(means + ellipsoids.reach), np.array(shape) - 1).astype(np.int64)
        self._touching = np.flatnonzero((self._high >= self._low).all(axis=1))

    @property
    def footprint(self) -> int:
        """Pairs of a Gaussian and a voxel of the box around it."""
        return int(self._box_voxels(self._touching).sum())

    def _box_voxels(self, ids: IndexArray) -> IndexArray:
        voxels: IndexArray = (self._high[ids] - self._low[ids] + 1).prod(axis=1)
        return voxels

    def values(self, field: str) -> npt.NDArray[np.generic]:  # [voxels]
        ellipsoids = self.ellipsoids
        if field == "attenuation":
            return self._sums(self._touching, ellipsoids.absorbed)[0].astype(np.float32)
        if field == "labels":
            return self._labels()
        if field == "coverage":
            return self._coverage(self._sums(self._touching, None)[0]).astype(np.float32)
        weight, weighted = self._sums(self._touching, None, ellipsoids.intensities)
        return (self._coverage(weight) * weighted / (weight + 1e-8)).astype(np.float32)

    @staticmethod
    def _coverage(weight: FloatArray) -> FloatArray:
        coverage: FloatArray = -np.expm1(-weight)
        return coverage

    def _labels(self) -> npt.NDArray[np.uint8]:
        found, heaviest = np.zeros(math.prod(self.shape), np.uint8), np.zeros(math.prod(self.shape))
        labels = self.ellipsoids.labels[self._touching]
        for label in np.unique(labels):
            (weight,) = self._sums(self._touching[labels == label], None)
            heavier = (weight > heaviest) & (weight >= MIN_WEIGHT_SUM)
            found[heavier], heaviest[heavier] = label, weight[heavier]
        return found

    def _sums(self, chosen: IndexArray, *wanted: FloatArray | None) -> list[FloatArray]:  # [n], [N]s -> [voxels]s
        """Σ factor·w of the chosen Gaussians at each voxel, for each of the wanted factors; for None Σ w."""
        totals = [np.zeros(math.prod(self.shape)) for _ in wanted]
        counts = self._box_voxels(chosen)
        ends = np.cumsum(counts)
        start = 0
        while start < len(chosen):
            self._limits.check_flag()
            before = ends[start - 1] if start else 0
            stop = max(start + 1, int(np.searchsorted(ends, before + POINTS_AT_ONCE, side="right")))
            ids = chosen[start:stop]
            owner, voxels, weight = self._weights(ids, counts[start:stop])
            for total, factors in zip(totals, wanted, strict=True):
                term = weight if factors is None else weight * factors[ids][owner]
                total += np.bincount(voxels, term, minlength=len(total))
            start = stop
        return totals

    def _weights(self, ids: IndexArray, counts: IndexArray) -> tuple[IndexArray, IndexArray, FloatArray]:
        """Each pair of a Gaussian and a voxel of its box: the place in `ids`, the voxel's number, and w."""
        owner = np.repeat(np.arange(len(ids)), counts)
        number = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
        low, sides = self._low[ids], self._high[ids] - self._low[ids] + 1
        width, height = sides[owner, 0], sides[owner, 1]
        index = np.stack([number % width, number // width % height, number // (width * height)], axis=1) + low[owner]
        offset = index + self._offset - self.ellipsoids.means[ids][owner]
        across = np.einsum("pij,pj->pi", self.ellipsoids.roots[ids][owner], offset)
        weight = np.minimum(np.exp(-0.5 * (across * across).sum(axis=1)), MAX_WEIGHT)
        counted = weight >= MIN_WEIGHT
        columns, rows, _ = self.shape
        voxels = (index[:, 2] * rows + index[:, 1]) * columns + index[:, 0]
        return owner[counted], voxels[counted], weight[counted]
