"""Speckle drawn from scatterers that are fixed in the tissue: its definition, and the kernel's way to the same.

Rendered frames show the mean of many looks; a scanner's frame is one, with the speckle of the scatterers in its slice.
A scene whose training fitted a `SpeckleModel` can put it back (docs/physics.md §9):

1. Tissue is divided into cells, each of which scatters as one, by a random phasor for each of two looks: a hash of the
   cell's place and the seed. Cells are as long as the point-spread function is wide, and turned within the image plane,
   so that a probe that moves along an axis does not cross the borders of all at once.
2. Samples of the cells are taken on a grid about as fine, in three planes across the slice; a carrier gives them phases
   where the probe is turned from the mean direction of the sweep. The phase that all of a frame have in common is
   nothing that an envelope shows.
3. They are weighted by the point-spread function, along depth and then across scan lines; both by depth.
4. The power of the looks, a floor added, is compressed logarithmically, and normalised to a mean of 0 and a deviation
   of 1. `strength` of the grey value of B-mode says how much of it is added there.

Places are integers, 16 bits after the point of a cell, modulo 2¹⁶ cells: a pose has the same speckle on every backend,
whatever frames are drawn beside it, but for the rounding of sums.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ultragray import _cpu
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.geometry.rotations import mean_axes
from ultragray.scene.gaussians import GaussianScene
from ultragray.scene.speckle import BANDS, LEVELS, SpeckleModel

FloatRows = npt.NDArray[np.float32]
IntRows = npt.NDArray[np.int32]
Words = npt.NDArray[np.uint32]

TURN_RAD = 0.47  # of the cells within the image plane
SHEAR = (0.618, 0.324)  # of cells along elevation, by the cells in the two other directions
SUBCELL_BITS = 16
CELL_NUMBER = np.uint32(0x9E3779B1)  # odd: neighbours get numbers far apart
SAMPLES_PER_SIGMA = 1.0  # of the narrowest point-spread function
REACH = 2.4  # of the point-spread function, in standard deviations
LEAST_SIGMA_PIXELS = 0.3
MOST_SIGMA_SAMPLES = 12.0  # so that no model makes frames slow
LANES = 16  # the kernel takes as many scan lines at once
MOST_PLANE_VARIANCE = 0.6  # in cells²: about as much as three planes can have
_BYTE_DEVIATION = math.sqrt((256**2 - 1) / 12.0)


@dataclass(frozen=True, eq=False)
class Samples:
    """The grid of samples for frames of one size, and their weights. A sample lies on every `row_step`-th row and
    `column_step`-th scan line, and beyond the borders of the image as far as the point-spread function reaches.
    """

    row_step: int
    column_step: int
    rows: IntRows  # [R] of the image
    columns: IntRows  # [K]
    row_weights: FloatRows  # [H, T]
    column_weights: FloatRows  # [H, column_step, U]
    plane_weights: FloatRows  # [R, 2]: of the plane in the middle of the slice, of the two beside it

    @classmethod
    def of(cls, model: SpeckleModel, probe: Probe, height: int, width: int) -> Samples:
        row_mm = probe.scan_line_length_mm / height
        depths = probe.depths_mm(height)
        column_mm = np.maximum([probe.lines.breadth_mm(depth) / width for depth in depths], 1e-6)
        lateral_cell, elevation_cell, axial_cell = model.cell_mm
        axial, lateral = (_by_depth(widths, probe, depths) for widths in (model.axial_mm, model.lateral_mm))
        row_step = max(1, int((axial / row_mm).min() / SAMPLES_PER_SIGMA))
        column_step = max(1, int((lateral / column_mm).min() / SAMPLES_PER_SIGMA))
        # A cell is a box, whose own variance is a part of the point-spread function's.
        down = np.minimum(_sigma_pixels(axial, axial_cell, np.full(height, row_mm)) / row_step, MOST_SIGMA_SAMPLES)
        across = np.minimum(_sigma_pixels(lateral, lateral_cell, column_mm) / column_step, MOST_SIGMA_SAMPLES)
        above, beside = math.ceil(REACH * down.max()), math.ceil(REACH * across.max())
        rows = (np.arange((height - 1) // row_step + 1 + 2 * above) - above) * row_step
        count = (width - 1) // column_step + 1 + 2 * beside
        columns = (np.arange(-(-count // LANES) * LANES) - beside) * column_step
        row_phase = (np.arange(height) % row_step) / row_step
        row_weights = _gaussian(np.arange(-above, above + 1) - row_phase[:, None], down[:, None])  # [H, T]
        column_phase = np.arange(column_step)[:, None] / column_step
        column_weights = _gaussian(np.arange(-beside, beside + 1) - column_phase, across[:, None, None])
        at_rows = _by_depth(model.elevation_mm, probe, probe.near_mm + row_mm * (rows + 0.5))
        variance = np.clip(np.square(at_rows / elevation_cell) - 1.0 / 12.0, 0.0, MOST_PLANE_VARIANCE)
        side = variance / (2.0 - 2.0 * variance)  # (side, 1, side) has this variance
        plane_weights = np.stack([np.ones_like(side), side], axis=1)
        power = _power(
            row_weights,
            column_weights.mean(axis=1),
            side[above + np.arange(height) // row_step],
            (row_step * row_mm / axial_cell, column_step * column_mm / lateral_cell),
        )
        row_weights /= np.sqrt(2.0 * power)[:, None] * _BYTE_DEVIATION
        return cls(
            row_step,
            column_step,
            rows.astype(np.int32),
            columns.astype(np.int32),
            *(weights.astype(np.float32) for weights in (row_weights, column_weights, plane_weights)),
        )


def _by_depth(widths: tuple[float, ...], probe: Probe, depths_mm: FloatArray) -> FloatArray:  # [D] -> [D]
    middles = probe.near_mm + (np.arange(BANDS) + 0.5) / BANDS * probe.scan_line_length_mm
    return np.interp(depths_mm, middles, widths)


def _sigma_pixels(sigma_mm: FloatArray, cell_mm: float, pixel_mm: FloatArray) -> FloatArray:  # [H] each
    return np.maximum(np.sqrt(np.maximum(sigma_mm**2 - cell_mm**2 / 12.0, 0.0)) / pixel_mm, LEAST_SIGMA_PIXELS)


def _gaussian(offset: FloatArray, sigma: FloatArray) -> FloatArray:
    values: FloatArray = np.exp(-0.5 * np.square(offset / sigma))
    values[np.abs(offset) > REACH * sigma + 0.5] = 0.0
    return values


def _power(
    row_weights: FloatArray,  # [H, T]
    column_weights: FloatArray,  # [H, U]
    side: FloatArray,  # [H]
    step: tuple[float, FloatArray],  # from sample to sample in cells, axial and lateral [H]
) -> FloatArray:  # [H]
    """Mean square of a row's weighted sums of samples of variance 1: samples in the same cell are the same."""
    own = [np.stack([np.convolve(row, row[::-1]) for row in weights]) for weights in (row_weights, column_weights)]
    down, across = (np.arange(correlation.shape[1]) - correlation.shape[1] // 2 for correlation in own)
    z = (down * step[0])[None, :, None]
    x = across[None, None, :] * step[1][:, None, None]
    cosine, sine = math.cos(TURN_RAD), math.sin(TURN_RAD)
    i, k = cosine * x - sine * z, sine * x + cosine * z
    j = SHEAR[0] * x + SHEAR[1] * z
    planes = (1.0 + 2.0 * side**2)[:, None, None] * _shared(j)
    planes = planes + (2.0 * side)[:, None, None] * (_shared(j + 1.0) + _shared(j - 1.0))
    planes = planes + (side**2)[:, None, None] * (_shared(j + 2.0) + _shared(j - 2.0))
    power: FloatArray = np.einsum("hz,hx,hzx->h", *own, _shared(i) * _shared(k) * planes)
    return power


def _shared(cells: FloatArray) -> FloatArray:
    """The probability that two points this far apart along an axis lie in the same cell."""
    return np.maximum(1.0 - np.abs(cells), 0.0)


@dataclass(frozen=True, eq=False)
class Places:
    """Where the samples of C poses lie: in cells, as integers with 16 bits after the point; and their phases."""

    starts: IntRows  # [C, 3, K] of the first row
    steps: IntRows  # [C, 3, K] from row to row
    beside: IntRows  # [C, 3] from plane to plane
    plane_phases: FloatRows  # [C, 2] from plane to plane: cosine and sine
    column_phases: FloatRows  # [C, 2, K]

    @classmethod
    def of(
        cls,
        model: SpeckleModel,
        samples: Samples,
        axes: FloatArray,
        probe: Probe,
        poses: FloatArray,
        size: tuple[int, int],
    ) -> Places:  # axes: [3, 3], columns: lateral, elevation and axial of the sweep; poses [C, 4, 4] mm
        height, width = size
        row_mm = probe.scan_line_length_mm / height
        across = probe.lines.start + probe.lines.span * (samples.columns + 0.5) / width
        origins, directions = (_in_space(vectors) for vectors in probe.lines.rays(across))  # [K, 3]
        first = origins + (probe.near_mm + row_mm * (samples.rows[0] + 0.5)) * directions
        to_cells = cell_matrix(model, axes) @ poses[:, :3, :3]  # [C, 3, 3]
        beginning = poses[:, :3, 3] @ cell_matrix(model, axes).T
        starts = np.einsum("cij,kj->cik", to_cells, first) + beginning[:, :, None]
        steps = np.einsum("cij,kj->cik", to_cells, row_mm * samples.row_step * directions)
        turned = model.wavenumber_per_mm * np.einsum("cij,i->cj", poses[:, :3, :3], axes[:, 2])  # [C, 3] rad/mm
        plane_phase = turned[:, 1] * model.cell_mm[1]
        middle = 0.5 * (probe.near_mm + probe.far_mm)
        column_phase = turned[:, :1] * (across if probe.lines.unit == "mm" else np.radians(across) * middle)
        return cls(
            _fixed(starts),
            _fixed(steps),
            _fixed(model.cell_mm[1] * to_cells[:, :, 1]),
            _phasors(plane_phase),
            _phasors(column_phase),
        )


def _in_space(vectors: FloatArray) -> FloatArray:  # [K, 2] (x, z) -> [K, 3]
    return np.stack([vectors[:, 0], np.zeros(len(vectors)), vectors[:, 1]], axis=1)


def cell_matrix(model: SpeckleModel, axes: FloatArray) -> FloatArray:  # [3, 3], [3, 3] -> [3, 3]
    """From mm in the frame of the sweep to cells."""
    cosine, sine = math.cos(TURN_RAD), math.sin(TURN_RAD)
    turned = np.array([[cosine, 0.0, -sine], [SHEAR[0], 1.0, SHEAR[1]], [sine, 0.0, cosine]])
    matrix: FloatArray = turned / np.array(model.cell_mm) @ axes.T
    return matrix


def _fixed(cells: FloatArray) -> IntRows:
    whole = np.floor(cells * 2.0**SUBCELL_BITS + 0.5).astype(np.int64)
    return np.ascontiguousarray(whole.astype(np.uint32).view(np.int32))


def _phasors(phase: FloatArray) -> FloatRows:  # [C, ...] -> [C, 2, ...]
    return np.ascontiguousarray(np.stack([np.cos(phase), np.sin(phase)], axis=1).astype(np.float32))


def sums(model: SpeckleModel, samples: Samples, places: Places, size: tuple[int, int]) -> npt.NDArray[np.complex128]:
    """The echoes of the scatterers in each pixel for each look, [C, 2, H, W], of mean power 1: the definition."""
    height, width = size
    side = samples.plane_weights[:, 1:].astype(np.float64)
    taken = np.zeros((len(places.starts), 2, len(samples.rows), len(samples.columns)), np.complex128)
    number = np.arange(len(samples.rows), dtype=np.uint32)[:, None]
    for pose, echoes in enumerate(taken):
        start, step = (one[pose].view(np.uint32)[:, None] for one in (places.starts, places.steps))  # [3, 1, K]
        beside = places.beside[pose].view(np.uint32)[:, None, None]
        turn = complex(*places.plane_phases[pose].tolist())
        for plane, weight in ((-1, side * turn.conjugate()), (0, np.ones_like(side)), (1, side * turn)):
            cells = (start + number * step + np.uint32(plane % 2**32) * beside) >> np.uint32(SUBCELL_BITS)
            numbers = ((cells[0] << np.uint32(16) | cells[1]) ^ cells[2] * CELL_NUMBER) + np.uint32(
                _scattered_seed(model)
            )
            echoes += weight * phasors(numbers)
        cosine, sine = places.column_phases[pose].astype(np.float64)
        echoes *= cosine + 1j * sine
    row, column = np.arange(height) // samples.row_step, np.arange(width)
    down = sum(
        weight[:, None] * taken[:, :, row + tap] for tap, weight in enumerate(samples.row_weights.T.astype(np.float64))
    )
    place, phase = column // samples.column_step, column % samples.column_step
    weights = samples.column_weights[:, phase].astype(np.float64)  # [H, W, U]
    return np.asarray(sum(weights[..., tap] * down[..., place + tap] for tap in range(weights.shape[-1])))


def phasors(numbers: Words) -> npt.NDArray[np.complex128]:  # [...] -> [2, ...]
    """The scatterer of each look: two bytes each of a hash, less their mean."""
    mixed = scattered(numbers)
    parts = [((mixed >> np.uint32(8 * byte)) & np.uint32(255)) - 127.5 for byte in range(4)]
    return np.stack([parts[0] + 1j * parts[1], parts[2] + 1j * parts[3]])


def scattered(numbers: Words) -> Words:
    """A hash of 32 bits (lowbias32 of C. Wellons)."""
    mixed: Words = numbers ^ (numbers >> np.uint32(16))
    mixed = mixed * np.uint32(0x7FEB352D)
    mixed = mixed ^ (mixed >> np.uint32(15))
    mixed = mixed * np.uint32(0x846CA68B)
    mixed = mixed ^ (mixed >> np.uint32(16))
    return mixed


def _scattered_seed(model: SpeckleModel) -> int:
    """Seeds beside each other would else be the same speckle, shifted by a cell."""
    return int(scattered(np.array([model.seed], np.uint32))[0])


@dataclass(frozen=True)
class Compression:
    """The logarithm to base 2 of a power of mean 1: the first look's share of the power, and the moments of the log."""

    first_look: float
    mean: float
    deviation: float
    skewness: float

    @classmethod
    @lru_cache(maxsize=256)
    def of(cls, looks: float, floor: float) -> Compression:
        """`looks` = 1/(a² + (1 − a)²) of the share a; the power is that of two exponential variables a and 1 − a."""
        first = 0.5 * (1.0 + math.sqrt(max(2.0 / looks - 1.0, 0.0)))
        second = 1.0 - first
        power = np.exp(np.linspace(-16.0, 4.0, 8001))
        if second < 1e-6:
            density = np.exp(-power)
        elif first - second < 1e-3:
            density = 4.0 * power * np.exp(-2.0 * power)
        else:
            density = (np.exp(-power / first) - np.exp(-power / second)) / (first - second)
        weights = density * power  # d power = power d log power
        weights /= weights.sum()
        level = np.log2(power + floor)
        mean = float(weights @ level)
        deviation = math.sqrt(float(weights @ np.square(level - mean)))
        skewness = float(weights @ ((level - mean) / deviation) ** 3)
        return cls(first, mean, deviation, skewness)


def speckle(
    model: SpeckleModel, axes: FloatArray, probe: Probe, poses: FloatArray, size: tuple[int, int]
) -> FloatArray:
    """Speckle [C, H, W] of mean 0 and deviation 1 at poses [C, 4, 4] in mm: the definition.

    `axes` [3, 3] has the sweep's lateral, elevation and axial directions in its columns.
    """
    samples = _samples(model, probe, *size)
    echoes = sums(model, samples, Places.of(model, samples, axes, probe, poses, size), size)
    compressed = Compression.of(model.looks, model.floor)
    shares = np.array([compressed.first_look, 1.0 - compressed.first_look])[:, None, None]
    power = (shares * np.square(np.abs(echoes))).sum(axis=1)
    level: FloatArray = (np.log2(power + model.floor) - compressed.mean) / compressed.deviation
    return level


def added(model: SpeckleModel, bmode: Tensor, pattern: Tensor) -> Tensor:  # [C, H, W] each
    """B-mode with speckle, by the strength at its grey values; in [0, 1]."""
    strength = torch.tensor(model.strength, dtype=bmode.dtype, device=bmode.device)
    place = bmode * (LEVELS - 1)
    level = place.long().clamp(0, LEVELS - 2)
    low = strength[level]
    return (bmode + (low + (place - level) * (strength[level + 1] - low)) * pattern).clamp(0.0, 1.0)


_samples = lru_cache(maxsize=16)(Samples.of)


def with_speckle(
    scene: GaussianScene,
    bmode: Tensor,  # [C, H, W]
    probe: Probe,
    poses: FloatArray,  # [C, 4, 4] mm, in the tissue at rest
    *,
    backend: str,
) -> Tensor:  # [C, H, W]
    """B-mode with the speckle of a scene that has its model, on the device and in the type that it has.

    The gradient is that of `bmode`. The reference takes the definition, other backends the kernel.
    """
    model = scene.info.speckle
    assert model is not None
    axes = scene.prepared("speckle axes", lambda: sweep_axes(scene.at_rest().training_poses))
    plain = bmode.detach()
    size = (int(bmode.shape[1]), int(bmode.shape[2]))
    if backend == "reference":
        speckled_bmode = added(model, plain, torch.from_numpy(speckle(model, axes, probe, poses, size)).to(plain))
    elif plain.device.type == "cpu":
        speckled_bmode = kernel_speckle(model, axes, probe, poses, plain)
    else:
        pattern = kernel_speckle(model, axes, probe, poses, torch.empty(plain.shape, device="cpu"), alone=True)
        speckled_bmode = added(model, plain, pattern.to(plain))
    return speckled_bmode if not bmode.requires_grad else bmode + (speckled_bmode - plain)


def sweep_axes(poses: FloatArray) -> FloatArray:  # [P, 4, 4] -> [3, 3]
    """The mean lateral, elevation and axial direction of training poses, in columns; of none: x, y and z."""
    return mean_axes(poses) if len(poses) else np.eye(3)


def kernel_speckle(
    model: SpeckleModel,
    axes: FloatArray,  # [3, 3]
    probe: Probe,
    poses: FloatArray,  # [C, 4, 4] mm
    bmode: Tensor,  # [C, H, W] float32 on the CPU
    *,
    alone: bool = False,
    instruction_set: str = "auto",
) -> Tensor:  # [C, H, W]
    """What `speckle` and `added` define, by the kernel; `alone`: the speckle itself, of frames of this size."""
    size = (int(bmode.shape[1]), int(bmode.shape[2]))
    samples = _samples(model, probe, *size)
    places = Places.of(model, samples, axes, probe, poses, size)
    compressed = Compression.of(model.looks, model.floor)
    out = torch.empty(bmode.shape, dtype=torch.float32, device="cpu")
    fields: dict[str, Any] = {
        name: getattr(samples, name) for name in ("row_weights", "column_weights", "plane_weights")
    }
    fields |= {name: getattr(places, name) for name in Places.__dataclass_fields__}
    _cpu.add_speckle(
        bmode.contiguous().numpy(),
        out.numpy(),
        alone=alone,
        strength=np.array(model.strength, np.float32),
        seed=_scattered_seed(model),
        first_look=compressed.first_look,
        floor=model.floor,
        mean=compressed.mean,
        scale=1.0 / compressed.deviation,
        row_step=samples.row_step,
        **fields,
        threads=torch.get_num_threads(),
        instruction_set=instruction_set,
    )
    return out
