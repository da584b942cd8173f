"""Smooth seeded noise: the irregularity of fascicles and septa, a function of position alone."""

from __future__ import annotations

import itertools

import numpy as np

from ...probe import FloatArray

_PERIOD = 32  # lattice cells, a power of two


class LatticeNoise:
    """Values in [−1, 1] at the nodes of a lattice with cells of a given size, interpolated smoothly between them."""

    def __init__(self, seed: int, cell_mm: tuple[float, float, float]) -> None:
        self._nodes = np.random.default_rng(seed).uniform(-1.0, 1.0, _PERIOD**3)
        self._cell_mm = np.asarray(cell_mm)

    def __call__(self, points: FloatArray) -> FloatArray:  # [N, 3] -> [N]
        """The noise at each point, mm."""
        scaled = points / self._cell_mm
        whole = np.floor(scaled)
        part = scaled - whole
        part *= part * (3.0 - 2.0 * part)
        low = whole.astype(np.int64) & (_PERIOD - 1)
        high = (low + 1) & (_PERIOD - 1)
        value = np.zeros(len(points))
        for corner in itertools.product((0, 1), repeat=3):
            node = np.zeros(len(points), dtype=np.int64)
            weight = np.ones(len(points))
            for axis, upper in enumerate(corner):
                node = node * _PERIOD + (high if upper else low)[:, axis]
                weight = weight * (part[:, axis] if upper else 1.0 - part[:, axis])
            value += weight * self._nodes[node]
        return value
