"""Smooth seeded noise: the irregularity of fascicles and septa, a function of position alone."""

from __future__ import annotations

import numpy as np

from ultragray.datasets.phantom.bone import Floats, Triple
from ultragray.datasets.sweep import IntArray

_PERIOD = 32  # lattice cells, a power of two
_LAST = _PERIOD - 1


class LatticeNoise:
    """Values in [−1, 1] at the nodes of a lattice with cells of a given size, interpolated smoothly between them."""

    def __init__(self, seed: int, cell_mm: Triple) -> None:
        nodes = np.random.default_rng(seed).uniform(-1.0, 1.0, (_PERIOD, _PERIOD, _PERIOD))
        self._nodes = nodes.astype(np.float32)
        self._cell_mm = cell_mm

    def __call__(self, points: Floats) -> Floats:  # [N, 3] -> [N]
        """The noise at each point, mm."""
        (i, u), (j, v), (k, w) = (self._cell(points[:, axis] / size) for axis, size in enumerate(self._cell_mm))
        nodes = self._nodes

        def along_z(i: IntArray, j: IntArray) -> Floats:
            near = nodes[i, j, k]
            value: Floats = near + w * (nodes[i, j, (k + 1) & _LAST] - near)
            return value

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
