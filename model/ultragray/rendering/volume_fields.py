"""The fields of a scene on the grids of volumes and slices (`ultragray.rendering.volumes`), and files of them.

Fields are sums over Gaussians as `reference` has them, without a probe: nothing is rendered on the way.
"""

from __future__ import annotations

import gzip
import math
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from ultragray.errors import InvalidArgument
from ultragray.files import atomic_path, npy_bytes, write_whole
from ultragray.geometry.probe import FloatArray
from ultragray.rendering.backends.reference import MAX_WEIGHT, MIN_WEIGHT, intensity, inverse_root_covariance
from ultragray.rendering.derived import MIN_WEIGHT_SUM
from ultragray.rendering.limits import UNLIMITED, Limits
from ultragray.rendering.pixels import image_file
from ultragray.rendering.volumes import SLICE_SUFFIXES, VOLUME_SUFFIXES, VolumeGrid, check_field
from ultragray.scene.gaussians import GaussianScene
from ultragray.scene.info import SceneInfo

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


def sample_volume(
    scene: GaussianScene, field: str, grid: VolumeGrid, limits: Limits = UNLIMITED
) -> Iterator[npt.NDArray[np.generic]]:
    """A field in slabs [k, J, I] that follow each other along the grid's last axis: float32, labels uint8.

    What is held at once does not grow with the grid. Raises InvalidArgument for a field that is none of VOLUME_FIELDS,
    and for labels of a scene that has none; while they are sampled FrameTooCostly and GivenUp by `limits`, whose
    footprint pixels are those of the boxes around Gaussians.
    """
    check_field(field, has_labels=scene.labels is not None)
    return _slabs(scene, field, grid, limits)


def sample_slice(
    scene: GaussianScene, field: str, grid: VolumeGrid, limits: Limits = UNLIMITED
) -> npt.NDArray[np.generic]:  # [J, I]
    """A field on a plane (`VolumeGrid.on_plane`). Raises what `sample_volume` raises."""
    return np.concatenate(list(sample_volume(scene, field, grid, limits)))[0]


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
        return int(self._box_voxels(self._touching).sum())

    def _box_voxels(self, ids: IndexArray) -> IndexArray:
        return (self._high[ids] - self._low[ids] + 1).prod(axis=1)

    def values(self, field: str) -> npt.NDArray[np.generic]:  # [voxels]
        ellipsoids = self.ellipsoids
        if field == "attenuation":
            return self._sums(self._touching, ellipsoids.absorbed)[0].astype(np.float32)
        if field == "labels":
            return self._labels()
        if field == "coverage":
            return -np.expm1(-self._sums(self._touching, None)[0]).astype(np.float32)
        weight, weighted = self._sums(self._touching, None, ellipsoids.intensities)
        return (-np.expm1(-weight) * weighted / (weight + 1e-8)).astype(np.float32)

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


# Slices as pictures; volumes as NIfTI-1 (.nii, .nii.gz) and NRRD (.nrrd), written slab by slab.
#
# The same volume is the same bytes. nibabel and pynrrd would want the whole volume in memory, so the headers are ours.
#
# Both formats say that their axes are right, anterior and superior (RAS+), which programs for patients expect. A
# scene knows no patient: its frame's x, y and z are written as these three, with unchanged numbers, as 3D Slicer
# takes the poses that arrive over OpenIGTLink. A program that shows LPS coordinates, such as ITK, negates the first
# two.

_COMPRESSION = 4  # of 1 to 9: beyond, seconds buy hardly a byte
_UINT8, _FLOAT32 = 2, 16  # data types of NIfTI
_ALIGNED, _MILLIMETRES = 2, 2
_VOXEL_OFFSET = 352
_NIFTI = "<i10s18sihcB8h3fhhhh8ffffhBB4fii80s24shh6f12f16s4s4x"


def write_volume(
    path: str | Path,
    scene: GaussianScene,
    field: str,
    grid: VolumeGrid,
    *,
    after_slab: Callable[[int], object] | None = None,
) -> None:
    """Write a field of a scene (`sample_volume`) in the format of the file's name, whole or not at all.

    `after_slab` is told how many of the grid's last axis are done; to stop, it raises. Raises InvalidArgument for a
    name that ends in none of VOLUME_SUFFIXES and what `sample_volume` raises; OSError.
    """
    path = Path(path)
    suffix = next((one for one in VOLUME_SUFFIXES if path.name.endswith(one)), None)
    if suffix is None:
        raise InvalidArgument(f"a volume must end in {', '.join(VOLUME_SUFFIXES)}, got {path.name!r}", field="output")
    slabs = sample_volume(scene, field, grid)
    with ExitStack() as stack:
        file: Any = stack.enter_context(stack.enter_context(atomic_path(path)).open("wb"))
        if suffix == ".nrrd":
            file.write(_nrrd_header(field, grid, scene.info.label_names))
        if suffix != ".nii":  # the header of NRRD is text before what is compressed
            file = stack.enter_context(gzip.GzipFile("", "wb", _COMPRESSION, file, mtime=0))
        if suffix != ".nrrd":
            file.write(_nifti_header(field, grid))
        done = 0
        for slab in slabs:
            file.write(slab.astype(slab.dtype.newbyteorder("<"), copy=False).tobytes())
            done += len(slab)
            if after_slab is not None:
                after_slab(done)


def write_slice(path: str | Path, scene: GaussianScene, field: str, grid: VolumeGrid) -> None:
    """Write a field on a plane (`sample_slice`) as .npy, or as a grey .png, whole or not at all.

    A PNG is 255 at 1, of attenuation at the largest value of the slice; labels keep their numbers. Raises
    InvalidArgument for another name and what `sample_slice` raises; OSError.
    """
    path = Path(path)
    if path.suffix not in SLICE_SUFFIXES:
        raise InvalidArgument(f"a slice must end in {', '.join(SLICE_SUFFIXES)}, got {path.name!r}", field="output")
    pixels = sample_slice(scene, field, grid)
    is_picture = path.suffix == ".png"
    write_whole(path, image_file(as_grey(pixels, field), ".png").tobytes() if is_picture else npy_bytes(pixels))


def as_grey(pixels: npt.NDArray[Any], field: str) -> npt.NDArray[Any]:  # [J, I] -> [J, I]
    """A slice as a picture shows it: white is 1, of attenuation its largest value; labels keep their numbers."""
    return pixels / pixels.max() if field == "attenuation" and pixels.any() else pixels


def volume_facts(info: SceneInfo, field: str, grid: VolumeGrid) -> dict[str, Any]:
    """The place of a volume or a slice and the meaning of its values, for JSON."""
    names = {str(number): name for number, name in info.label_names.items()} if field == "labels" else {}
    shape, affine = list(grid.shape), grid.affine.tolist()
    return {"field": field, "shape": shape, "spacing_mm": grid.spacing_mm, "affine": affine, "label_names": names}


def _nifti_header(field: str, grid: VolumeGrid) -> bytes:  # [352]
    """The header of NIfTI-1 and four bytes that say that no extension follows."""
    labels = field == "labels"
    return struct.pack(
        _NIFTI,
        *(348, b"", b"", 0, 0, b"r", 0),
        *(3, *grid.shape, 1, 1, 1, 1),
        *(0.0, 0.0, 0.0, 0),
        *(_UINT8 if labels else _FLOAT32, 8 if labels else 32, 0),
        *(1.0, *3 * (grid.spacing_mm,), 0.0, 0.0, 0.0, 0.0),
        *(_VOXEL_OFFSET, 1.0, 0.0, 0, 0, _MILLIMETRES),
        *(0.0, 0.0, 0.0, 0.0, 0, 0),
        *(f"UltraG-Ray {field}".encode(), b"", 0, _ALIGNED),
        *6 * (0.0,),
        *grid.affine[:3].ravel().tolist(),
        *(b"", b"n+1\0"),
    )


def _nrrd_header(field: str, grid: VolumeGrid, label_names: Mapping[int, str]) -> bytes:
    vectors = (*(axis * grid.spacing_mm for axis in grid.axes), grid.origin_mm)
    *directions, origin = (f"({','.join(repr(float(value)) for value in vector)})" for vector in vectors)
    lines = [
        "NRRD0005",
        f"content: UltraG-Ray {field}",
        f"type: {'uint8' if field == 'labels' else 'float'}",
        "dimension: 3",
        "space: right-anterior-superior",
        f"sizes: {' '.join(map(str, grid.shape))}",
        f"space directions: {' '.join(directions)}",
        "kinds: domain domain domain",
        'space units: "mm" "mm" "mm"',
        f"space origin: {origin}",
        "endian: little",
        "encoding: gzip",
    ]
    if field == "labels":
        names = {number: name.replace("\\", "\\\\").replace("\n", "\\n") for number, name in label_names.items()}
        lines += [f"label {number}:={name}" for number, name in sorted(names.items())]
    return ("\n".join(lines) + "\n\n").encode()
