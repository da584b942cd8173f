"""B-mode frames of the phantom: scatterers under a beam, attenuation along the scan lines, envelope, log compression.

One frame: every scatterer within the slice adds its amplitude, with the phase of its depth and the weight of the
beam in elevation, to a grid finer than the image. What tissue lies above takes its share there. The grid is convolved
with the pulse along depth and with the beam, which widens away from its focus, across; its magnitude is the envelope.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...pose import check_poses
from ...probe import FloatArray, LinearProbe
from ..sweep import ByteArray, IntArray
from . import acoustics
from .anatomy import Tissue, tissue_at
from .scatterers import Float32Array, ScattererField, Scatterers

Complex64Array = npt.NDArray[np.complex64]

FINER = 2  # grid cells a pixel, each way
MARGIN_MM = 2.0  # around the image, for what the beam and the pulse still reach
ELEVATION_REACH = 2.5  # standard deviations of the slice
DYNAMIC_RANGE_DB = 60.0
MUSCLE_GREY = 0.37
MUSCLE_POWER = 0.02


def simulate(poses: npt.ArrayLike, *, probe: LinearProbe, height: int, width: int) -> ByteArray:  # [F, H, W]
    """B-mode frames of the phantom from poses [F, 4, 4], mm: the same scatterers in all, the same on every call.

    Raises InvalidPose for poses that are not rigid.
    """
    field, grid = ScattererField(), Grid.of(probe, height, width)
    frames = np.zeros((len(checked := check_poses(poses)), height, width), dtype=np.uint8)
    for frame, pose in zip(frames, checked, strict=True):
        frame[:] = _compressed(_power(field, grid, pose))
    return frames


def bone_attenuation_db(
    poses: npt.ArrayLike, *, probe: LinearProbe, height: int, width: int
) -> Float32Array:  # [F, H, W]
    """What bone takes from the echo of each pixel, there and back, in dB: where the shadows are.

    Raises InvalidPose for poses that are not rigid.
    """
    grid = Grid.of(probe, height, width)
    per_mm = acoustics.round_trip_db_per_mm()[Tissue.BONE]
    maps = np.zeros((len(checked := check_poses(poses)), height, width), dtype=np.float32)
    for attenuation, pose in zip(maps, checked, strict=True):
        bone = grid.tissue(pose) == Tissue.BONE
        attenuation[:] = grid.pixels(grid.above(per_mm * bone))
    return maps


@dataclass(frozen=True)
class Grid:
    """Cells finer than the pixels of an image and reaching beyond it: R rows of depth, C columns."""

    probe: LinearProbe
    height: int
    width: int
    cell_mm: tuple[float, float]  # depth, lateral
    margins: tuple[int, int]  # cells before the first row, and beside the first column

    @classmethod
    def of(cls, probe: LinearProbe, height: int, width: int) -> Grid:
        """The grid of an image of H rows and W scan lines."""
        cell_mm = (probe.scan_line_length_mm / (FINER * height), probe.width_mm / (FINER * width))
        depth_margin, lateral_margin = (math.ceil(MARGIN_MM / size) for size in cell_mm)
        return cls(probe, height, width, cell_mm, (depth_margin, lateral_margin))

    @property
    def shape(self) -> tuple[int, int]:
        return FINER * self.height + 2 * self.margins[0], FINER * self.width + 2 * self.margins[1]

    @property
    def first_mm(self) -> tuple[float, float]:
        """Depth and lateral position of the grid's corner."""
        depth = self.probe.near_mm - self.margins[0] * self.cell_mm[0]
        return depth, -0.5 * self.probe.width_mm - self.margins[1] * self.cell_mm[1]

    @property
    def depths_mm(self) -> FloatArray:  # [R]
        return self.first_mm[0] + (np.arange(self.shape[0]) + 0.5) * self.cell_mm[0]

    @property
    def laterals_mm(self) -> FloatArray:  # [C]
        return self.first_mm[1] + (np.arange(self.shape[1]) + 0.5) * self.cell_mm[1]

    def cells(self, x: Float32Array, z: Float32Array) -> tuple[npt.NDArray[np.bool_], IntArray]:  # [N], [M]
        """Which points lie in the grid, and the number of the cell of each that does."""
        row = np.floor((z - self.first_mm[0]) / self.cell_mm[0]).astype(np.int64)
        column = np.floor((x - self.first_mm[1]) / self.cell_mm[1]).astype(np.int64)
        rows, columns = self.shape
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        return inside, row[inside] * columns + column[inside]

    def tissue(self, pose: FloatArray) -> npt.NDArray[np.uint8]:  # [R, C]
        """What lies in each cell of the image plane; the columns of one scan line share it."""
        x = self.laterals_mm.reshape(-1, FINER).mean(axis=1)
        plane = pose[:3, 3] + self.depths_mm[:, None, None] * pose[:3, 2] + x[:, None] * pose[:3, 0]  # [R, C / 2, 3]
        return np.repeat(tissue_at(plane.reshape(-1, 3)).reshape(plane.shape[:2]), FINER, axis=1)

    def above(self, per_mm: FloatArray) -> FloatArray:  # [R, C] -> [R, C]
        """The sum of something over each scan line, from the probe's face down to the middle of each cell."""
        seen = np.where(self.depths_mm[:, None] > 0.0, per_mm, 0.0)
        total: FloatArray = self.cell_mm[0] * (np.cumsum(seen, axis=0) - 0.5 * seen)
        return total

    def pixels(self, values: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:  # [R, C] -> [H, W]
        """The mean over the cells of each pixel."""
        top, left = self.margins
        image = values[top : top + FINER * self.height, left : left + FINER * self.width]
        mean: npt.NDArray[np.floating] = image.reshape(self.height, FINER, self.width, FINER).mean(axis=(1, 3))
        return mean


def _power(field: ScattererField, grid: Grid, pose: FloatArray) -> npt.NDArray[np.floating]:  # [H, W]
    """Mean square of the envelope over each pixel, about 1 in muscle."""
    echoes = _echoes(field, grid, pose)
    gain_db = acoustics.compensated_db_per_mm() * grid.depths_mm[:, None]
    loss_db = grid.above(acoustics.round_trip_db_per_mm()[grid.tissue(pose)])
    echoes *= (10.0 ** ((gain_db - loss_db) / 20.0)).astype(np.float32)
    return grid.pixels(np.abs(_blurred(echoes, grid)) ** 2) / MUSCLE_POWER


def _echoes(field: ScattererField, grid: Grid, pose: FloatArray) -> Complex64Array:  # [R, C]
    """The scatterers of the slice on the grid, as phasors at the pulse's frequency."""
    depths, laterals = grid.depths_mm, grid.laterals_mm
    reach = ELEVATION_REACH * float(acoustics.elevation_sigma_mm(depths).max())
    low, high = np.array([laterals[0], -reach, depths[0]]), np.array([laterals[-1], reach, depths[-1]])
    scatterers = field.slice(pose, low, high)
    tissue = _binned(grid, pose, scatterers.points_mm, scatterers.amplitudes)
    return tissue + _binned(grid, pose, scatterers.surface_mm, _reflected(scatterers, pose))


def _reflected(scatterers: Scatterers, pose: FloatArray) -> Float32Array:  # [M]
    """Amplitudes of the scatterers on interfaces for the beam of this pose."""
    cosine = np.minimum(np.abs(scatterers.normals @ pose[:3, 2].astype(np.float32)), 1.0)
    lobe = np.exp(-0.5 * (np.arccos(cosine) / scatterers.lobe_rad) ** 2)
    reflected: Float32Array = scatterers.diffuse + scatterers.specular * lobe
    return reflected


def _binned(grid: Grid, pose: FloatArray, points: Float32Array, amplitudes: Float32Array) -> Complex64Array:  # [R, C]
    local = (points - pose[:3, 3].astype(np.float32)) @ pose[:3, :3].astype(np.float32)
    sigma = acoustics.elevation_sigma_mm(local[:, 2])
    inside, cells = grid.cells(local[:, 0], local[:, 2])
    inside_slice = np.abs(local[inside, 1]) < ELEVATION_REACH * sigma[inside]
    chosen, cells = np.flatnonzero(inside)[inside_slice], cells[inside_slice]
    _, y, z = local[chosen].T
    weights = amplitudes[chosen] * np.exp(-0.5 * (y / sigma[chosen]) ** 2)
    phase = (4.0 * math.pi / acoustics.WAVELENGTH_MM) * z
    count = grid.shape[0] * grid.shape[1]
    real = np.bincount(cells, weights * np.cos(phase), count)
    imaginary = np.bincount(cells, weights * np.sin(phase), count)
    return (real + 1j * imaginary).astype(np.complex64).reshape(grid.shape)


def _blurred(echoes: Complex64Array, grid: Grid) -> Complex64Array:  # [R, C]
    """Echoes under the pulse and under the beam, at unit mean power for scatterers of unit density and amplitude."""
    rows, columns = echoes.shape
    down = 2.0 * math.pi * np.fft.fftfreq(rows, grid.cell_mm[0])  # rad/mm
    across = 2.0 * math.pi * np.fft.fftfreq(columns, grid.cell_mm[1])
    sigma = acoustics.lateral_sigma_mm(grid.depths_mm)
    pulse = np.exp(-0.5 * (acoustics.PULSE_SIGMA_MM * down) ** 2)[:, None]
    beam = np.exp(-0.5 * (sigma[:, None] * across) ** 2)
    # A wider beam meets more scatterers: the gain that keeps their power the same.
    even = np.sqrt(sigma / acoustics.elevation_sigma_mm(grid.depths_mm))[:, None]
    echoes = np.fft.ifft(np.fft.fft(echoes, axis=0) * pulse.astype(np.float32), axis=0)
    echoes = np.fft.ifft(np.fft.fft(echoes, axis=1) * (even * beam).astype(np.float32), axis=1)
    return echoes


def _compressed(power: npt.NDArray[np.floating]) -> ByteArray:  # [H, W]
    grey = MUSCLE_GREY + 10.0 * np.log10(power + 1e-12) / DYNAMIC_RANGE_DB
    return np.round(255.0 * np.clip(grey, 0.0, 1.0)).astype(np.uint8)
