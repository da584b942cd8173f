"""The scatterers of the phantom: points at random in the tissue and on its interfaces, made block by block.

A block's scatterers follow from its place alone, so every frame of every sweep sees the same ones.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from ultragray.errors import InvalidProbe
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.learn.sweep import ByteArray, IntArray
from ultragray.phantom import anatomy
from ultragray.phantom.anatomy import SPINE, Floats, Phantom

Float32Array = npt.NDArray[np.float32]

BLOCK_MM = 8.0
PER_MM3 = 8.0  # about five in a cell of the beam's resolution: speckle is fully developed
LAST_BLOCKS = 256  # kept for calls of one frame each, about 20 MB: neighbouring frames share most of their blocks
BAND_MM = 0.4  # scatterers this near to an interface are repeated on it
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
        axis = pose[:3, 1].astype(np.float32)
        zero = float(pose[:3, 3] @ pose[:3, 1])
        in_tissue, on_surface = (self.points_mm @ axis - zero, self.surface_mm @ axis - zero)
        inside = np.flatnonzero((in_tissue > low_mm) & (in_tissue < high_mm))
        facing = np.flatnonzero((on_surface > low_mm) & (on_surface < high_mm))
        on = self.surface_mm, self.normals, self.specular, self.diffuse, self.lobe_rad
        return Scatterers(self.points_mm[inside], self.amplitudes[inside], *(values[facing] for values in on))

    @classmethod
    def join(cls, parts: list[Scatterers]) -> Scatterers:
        names = cls.__dataclass_fields__
        return cls(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


_NUMBERS, _VECTORS = np.zeros(0, dtype=np.float32), np.zeros((0, 3), dtype=np.float32)
NOTHING = Scatterers(_VECTORS, _NUMBERS, _VECTORS, _VECTORS, _NUMBERS, _NUMBERS, _NUMBERS)


class ScattererField:
    """The scatterers of a phantom, each block made when a frame first needs it."""

    def __init__(self, phantom: Phantom = SPINE) -> None:
        self._phantom = phantom
        self._blocks: dict[tuple[int, int, int], Scatterers] = {}

    def slice(self, pose: FloatArray, low_mm: FloatArray, high_mm: FloatArray) -> Scatterers:
        """The scatterers between two elevations, in the blocks that touch a box [3], [3] of the frame of a pose."""
        blocks = (self._block(index) for index in _blocks_near(pose, low_mm, high_mm))
        return Scatterers.join([NOTHING, *(block.between(pose, low_mm[1], high_mm[1]) for block in blocks)])

    def _block(self, index: tuple[int, int, int]) -> Scatterers:
        if index not in self._blocks:
            self._blocks[index] = _scatterers(self._phantom, index)
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
def _scatterers(phantom: Phantom, index: tuple[int, int, int]) -> Scatterers:
    rng = np.random.default_rng([_SEED, *(i + _OFFSET for i in index)])
    count = round(PER_MM3 * BLOCK_MM**3)
    points: Float32Array = ((np.asarray(index) + rng.random((count, 3))) * BLOCK_MM).astype(np.float32)
    drawn = phantom.straightened(points)
    labels = phantom.tissue_drawn(drawn)
    amplitudes = phantom.backscatter_amplitudes()[labels] * rng.normal(0.0, 1.0, count)
    for tissue, texture in phantom.textures.items():
        inside = labels == tissue
        amplitudes[inside] *= 10.0 ** (texture.strength_db / 20.0 * texture.noise(drawn[inside]))
    parts = [_on(interface, phantom, rng, points, drawn) for interface in phantom.interfaces]
    surface, normals, specular, diffuse, lobe = (np.concatenate(column) for column in zip(*parts, strict=True))
    heard = amplitudes != 0.0
    return Scatterers(
        *(
            np.asarray(values, dtype=np.float32)
            for values in (points[heard], amplitudes[heard], surface, normals, specular, diffuse, lobe)
        )
    )


def _on(
    interface: anatomy.Interface, phantom: Phantom, rng: np.random.Generator, points: Floats, drawn: Floats
) -> tuple[Floats, ...]:  # [M, 3], [M, 3], [M], [M], [M]
    """The scatterers near an interface moved onto it, with its normals there and their amplitudes."""
    low, high = interface.depths_mm
    near = np.flatnonzero((points[:, 2] > low) & (points[:, 2] < high))
    level = interface.level(drawn[near])
    close = np.abs(level) < 2.0 * BAND_MM  # the function is only roughly a distance
    near, level = near[close], level[close]
    shifted = (points[near] + _GRADIENT_STEP_MM * axis for axis in np.eye(3, dtype=np.float32))
    steps = [interface.level(phantom.straightened(there)) - level for there in shifted]
    gradient = np.stack(steps, axis=1) / _GRADIENT_STEP_MM  # of the interface's function, in the phantom's frame
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


# B-mode frames of the phantom: scatterers under a beam, attenuation along the scan lines, envelope, log compression.
#
# One frame: every scatterer within the slice adds its amplitude, with the phase of its depth and the weight of the
# beam in elevation, to a grid finer than the image. What tissue lies above takes its share there. The grid is
# convolved with the pulse along depth and with the beam, which widens away from its focus, across; its magnitude is
# the envelope.

Complex64Array = npt.NDArray[np.complex64]

CELLS_PER_ROW = 2  # the pulse is shorter than the beam is wide
MARGIN_MM = 2.0  # around the image, for what the beam and the pulse still reach
DYNAMIC_RANGE_DB = 60.0
MUSCLE_GREY = 0.23  # of muscle's scatterers at their mean power; fibres and fascia are brighter


def simulate(
    poses: npt.ArrayLike, *, probe: Probe, height: int, width: int, phantom: Phantom = SPINE
) -> ByteArray:  # [F, H, W]
    """B-mode frames of a phantom from poses [F, 4, 4], mm: the same scatterers in all, the same on every call.

    Raises InvalidPose for poses that are not rigid.
    """
    field, grid = ScattererField(phantom), Grid.of(probe, height, width, phantom)
    checked = check_poses(poses)
    frames = np.zeros((len(checked), height, width), dtype=np.uint8)
    for frame, pose in zip(frames, checked, strict=True):
        grey = MUSCLE_GREY + 10.0 * np.log10(_power(field, grid, pose) + 1e-12) / DYNAMIC_RANGE_DB
        frame[:] = np.round(255.0 * np.clip(grey, 0.0, 1.0)).astype(np.uint8)
    return frames


def bone_attenuation_db(poses: npt.ArrayLike, *, probe: Probe, height: int, width: int) -> Float32Array:  # [F, H, W]
    """The loss of each pixel's echo in bone, there and back, in dB: where the shadows are.

    Raises InvalidPose for poses that are not rigid.
    """
    grid = Grid.of(probe, height, width)
    per_mm = SPINE.round_trip_db_per_mm()[anatomy.Tissue.BONE]
    checked = check_poses(poses)
    maps = np.zeros((len(checked), height, width), dtype=np.float32)
    for attenuation, pose in zip(maps, checked, strict=True):
        bone = grid.tissue(pose) == anatomy.Tissue.BONE
        attenuation[:] = grid.pixels(grid.above(per_mm * bone))
    return maps


def tissues(
    poses: npt.ArrayLike, *, probe: Probe, height: int, width: int, phantom: Phantom = SPINE
) -> ByteArray:  # [F, H, W]
    """The number of the tissue in the middle of each pixel: the truth of a segmentation of `simulate`'s frames.

    Raises InvalidPose for poses that are not rigid, and InvalidProbe for a probe of lines that are not upright.
    """
    grid = Grid.of(probe, height, width, phantom)
    checked = check_poses(poses)
    maps = np.zeros((len(checked), height, width), dtype=np.uint8)
    for labels, pose in zip(maps, checked, strict=True):
        labels[:] = grid.tissue_of_pixels(pose)
    return maps


@dataclass(frozen=True)
class Grid:
    """Two cells a pixel, one above the other, and a margin around the image: R rows of depth, C scan lines."""

    probe: Probe
    height: int
    width: int
    cell_mm: tuple[float, float]  # depth, lateral
    margins: tuple[int, int]  # cells before the first row, and beside the first column
    phantom: Phantom = SPINE

    @classmethod
    def of(cls, probe: Probe, height: int, width: int, phantom: Phantom = SPINE) -> Grid:
        """The grid of an image of H rows and W scan lines. Raises InvalidProbe unless these are upright."""
        if not probe.is_true_to_scale:
            raise InvalidProbe(f"the phantom is scanned along upright lines, got {probe}", field="probe")
        cell_mm = (probe.scan_line_length_mm / (CELLS_PER_ROW * height), probe.lines.span / width)
        depth_margin, lateral_margin = (math.ceil(MARGIN_MM / size) for size in cell_mm)
        return cls(probe, height, width, cell_mm, (depth_margin, lateral_margin), phantom)

    @property
    def shape(self) -> tuple[int, int]:
        return CELLS_PER_ROW * self.height + 2 * self.margins[0], self.width + 2 * self.margins[1]

    @property
    def first_mm(self) -> tuple[float, float]:
        depth = self.probe.near_mm - self.margins[0] * self.cell_mm[0]
        return depth, -0.5 * self.probe.lines.span - self.margins[1] * self.cell_mm[1]

    @property
    def depths_mm(self) -> Floats:  # [R]
        return self.first_mm[0] + (np.arange(self.shape[0]) + 0.5) * self.cell_mm[0]

    @property
    def laterals_mm(self) -> Floats:  # [C]
        return self.first_mm[1] + (np.arange(self.shape[1]) + 0.5) * self.cell_mm[1]

    def cells(self, x: Float32Array, z: Float32Array) -> tuple[npt.NDArray[np.bool_], IntArray]:  # [N], [M]
        """A mask of the points that lie in the grid, and the number of the cell of each that does."""
        row = np.floor((z - self.first_mm[0]) / self.cell_mm[0]).astype(np.int64)
        column = np.floor((x - self.first_mm[1]) / self.cell_mm[1]).astype(np.int64)
        rows, columns = self.shape
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        return inside, row[inside] * columns + column[inside]

    def tissue(self, pose: FloatArray) -> npt.NDArray[np.uint8]:  # [R, C]
        return self._tissue(pose, self.depths_mm, self.laterals_mm)

    def tissue_of_pixels(self, pose: FloatArray) -> npt.NDArray[np.uint8]:  # [H, W]
        """The tissue in the middle of each pixel, which is the edge of two cells."""
        top, left = self.margins
        first = top + CELLS_PER_ROW // 2
        edges_mm = self.depths_mm - 0.5 * self.cell_mm[0]
        rows = edges_mm[first : first + CELLS_PER_ROW * self.height : CELLS_PER_ROW]
        return self._tissue(pose, rows, self.laterals_mm[left : left + self.width])

    def _tissue(self, pose: FloatArray, depths_mm: Floats, laterals_mm: Floats) -> npt.NDArray[np.uint8]:
        across = pose[:3, 3] + laterals_mm[:, None] * pose[:3, 0]
        points = across + depths_mm[:, None, None] * pose[:3, 2]  # [R, C, 3]
        tissues = self.phantom.tissue_at(points.reshape(-1, 3).astype(np.float32))
        return tissues.reshape(len(depths_mm), len(laterals_mm))

    def above(self, per_mm: FloatArray) -> FloatArray:  # [R, C] -> [R, C]
        """The sum of something over each scan line, from the probe's face down to the middle of each cell."""
        seen = np.where(self.depths_mm[:, None] > 0.0, per_mm, 0.0)
        return self.cell_mm[0] * (np.cumsum(seen, axis=0) - 0.5 * seen)

    def pixels(self, values: Floats) -> Floats:  # [R, C] -> [H, W]
        top, left = self.margins
        image = values[top : top + CELLS_PER_ROW * self.height, left : left + self.width]
        cells: Floats = image.reshape(self.height, CELLS_PER_ROW, self.width).mean(axis=1)
        return cells


def _power(field: ScattererField, grid: Grid, pose: FloatArray) -> Floats:  # [H, W]
    """Mean square of the envelope over each pixel and the frequencies of the scanner, 1 in muscle."""
    gain_db = 0.2 * anatomy.FREQUENCY_MHZ * anatomy.COMPENSATED * grid.depths_mm[:, None]
    loss_db = grid.above(grid.phantom.round_trip_db_per_mm()[grid.tissue(pose)])
    sensitivity = (10.0 ** ((gain_db - loss_db) / 20.0)).astype(np.float32)
    looks = [np.abs(_blurred(echoes * sensitivity, grid)) ** 2 for echoes in _echoes(field, grid, pose)]
    return grid.pixels(np.mean(looks, axis=0))


def _echoes(field: ScattererField, grid: Grid, pose: FloatArray) -> Iterator[Complex64Array]:  # [R, C]
    """The scatterers of the slice on the grid, as phasors at each frequency."""
    depths, laterals = grid.depths_mm, grid.laterals_mm
    reach = anatomy.ELEVATION_REACH * float(anatomy.elevation_sigma_mm(depths).max())
    low, high = np.array([laterals[0], -reach, depths[0]]), np.array([laterals[-1], reach, depths[-1]])
    scatterers = field.slice(pose, low, high)
    points = np.concatenate([scatterers.points_mm, scatterers.surface_mm])
    cosine = np.minimum(np.abs(scatterers.normals @ pose[:3, 2].astype(np.float32)), 1.0)
    lobe = np.exp(-0.5 * (np.arccos(cosine) / scatterers.lobe_rad) ** 2)
    amplitudes = np.concatenate([scatterers.amplitudes, scatterers.diffuse + scatterers.specular * lobe])
    local = (points - pose[:3, 3].astype(np.float32)) @ pose[:3, :3].astype(np.float32)
    inside, cells = grid.cells(local[:, 0], local[:, 2])
    _, y, z = local[inside].T
    weights = amplitudes[inside] * anatomy.elevation_weight(y, z)
    count = grid.shape[0] * grid.shape[1]
    for frequency in anatomy.FREQUENCIES_MHZ:
        phase = np.float32(4.0 * math.pi * frequency / anatomy.SPEED_MM_PER_US) * z
        echoes = np.empty(count, dtype=np.complex64)
        echoes.real = np.bincount(cells, weights * np.cos(phase), count)
        echoes.imag = np.bincount(cells, weights * np.sin(phase), count)
        yield echoes.reshape(grid.shape)


def _blurred(echoes: Complex64Array, grid: Grid) -> Complex64Array:  # [R, C]
    """Echoes under the pulse and the beam, at unit mean power where the scatterers' amplitudes are standard normal."""
    rows, columns = echoes.shape
    down = 2.0 * math.pi * np.fft.fftfreq(rows, grid.cell_mm[0])  # rad/mm
    across = 2.0 * math.pi * np.fft.fftfreq(columns, grid.cell_mm[1])
    sigma = anatomy.lateral_sigma_mm(grid.depths_mm)
    pulse = np.exp(-0.5 * (anatomy.PULSE_SIGMA_MM * down) ** 2)[:, None]
    beam = np.exp(-0.5 * (sigma[:, None] * across) ** 2)
    # Σ amplitude² over the scatterers of one pixel, for kernels of unit sum: what a wider beam gathers is divided out.
    elevation = anatomy.elevation_sigma_mm(grid.depths_mm)
    cell = grid.cell_mm[0] * grid.cell_mm[1]
    gathered = PER_MM3 * cell**2 * elevation / (4.0 * math.sqrt(math.pi) * sigma * anatomy.PULSE_SIGMA_MM)
    beam /= np.sqrt(gathered)[:, None]
    pulsed = np.fft.ifft(np.fft.fft(echoes, axis=0) * pulse.astype(np.float32), axis=0)
    blurred = np.fft.ifft(np.fft.fft(pulsed, axis=1) * beam.astype(np.float32), axis=1)
    return blurred.astype(np.complex64)
