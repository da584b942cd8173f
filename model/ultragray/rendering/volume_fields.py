"""The fields of a scene on the grids of volumes and slices (`ultragray.rendering.volumes`), and files of them.

Fields are sums over Gaussians as `reference` has them, without a probe: a layer of voxels is a plane through the scene,
on which the CPU's kernel sums as it does for frames, but every Gaussian, wherever its mean lies, and nothing absorbs.
"""

from __future__ import annotations

import gzip
import math
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ultragray.errors import InvalidArgument
from ultragray.files import atomic_path, npy_bytes, write_whole
from ultragray.rendering.backends import cpu
from ultragray.rendering.derived import heaviest_labels, label_parts
from ultragray.rendering.limits import UNLIMITED, Limits
from ultragray.rendering.pixels import png_file
from ultragray.rendering.volumes import SLICE_SUFFIXES, VOLUME_SUFFIXES, VolumeGrid, as_grey, check_field
from ultragray.scene.gaussians import GaussianScene
from ultragray.scene.info import SceneInfo

VOXELS_AT_ONCE = 1 << 22  # of a slab: some 50 MB
_CERTAIN = 40.0  # the logit of a weight of 1
_SH_C0 = 0.5 / math.sqrt(math.pi)  # the harmonic of degree 0


def sample_volume(
    scene: GaussianScene, field: str, grid: VolumeGrid, limits: Limits = UNLIMITED
) -> Iterator[npt.NDArray[np.generic]]:
    """A field in slabs [k, J, I] that follow each other along the grid's last axis: float32, labels uint8.

    What is held at once does not grow with the grid. Raises InvalidArgument for a field that is none of VOLUME_FIELDS,
    and for labels of a scene that has none; while they are sampled FrameTooCostly and GivenUp by `limits`, as a frame
    of such a size would.
    """
    check_field(field, has_labels=scene.labels is not None)
    return _slabs(scene, field, grid, limits)


def sample_slice(
    scene: GaussianScene, field: str, grid: VolumeGrid, limits: Limits = UNLIMITED
) -> npt.NDArray[np.generic]:  # [J, I]
    """A field on a plane (`VolumeGrid.on_plane`). Raises what `sample_volume` raises."""
    plane: npt.NDArray[np.generic] = np.concatenate(list(sample_volume(scene, field, grid, limits)))[0]
    return plane


def _slabs(scene: GaussianScene, field: str, grid: VolumeGrid, limits: Limits) -> Iterator[npt.NDArray[np.generic]]:
    parts = scene.prepared(f"volumes of {field}", lambda: _parts(scene, field))
    columns, rows, depth = grid.shape
    at_once = max(1, VOXELS_AT_ONCE // (columns * rows))
    corner = grid.pose
    corner[:3, 3] -= grid.spacing_mm / 2.0 * (grid.axes[0] + grid.axes[1])
    for first in range(0, depth, at_once):
        poses = np.tile(corner, (min(at_once, depth - first), 1, 1))
        poses[:, :3, 3] += (first + np.arange(len(poses)))[:, None] * grid.spacing_mm * grid.axes[2]
        sums = (
            (label, cpu.plane_sums(part, part.poses_to_scene_cm(poses), rows, columns, grid.spacing_mm / 10.0, limits))
            for label, part in parts
        )
        yield _values(field, sums, (len(poses), rows, columns))


def _values(
    field: str, sums: Iterable[tuple[int, tuple[Tensor, Tensor]]], shape: tuple[int, int, int]
) -> npt.NDArray[np.generic]:  # [k, J, I]
    """A field from Σ w and Σ I·w of each part of the scene."""
    if field == "labels":
        return heaviest_labels(((label, weight) for label, (weight, _) in sums), torch.zeros(shape)).numpy()
    ((_, (weight, weighted)),) = sums
    if field == "attenuation":
        return weighted.mul_(0.1).numpy()
    coverage = torch.expm1(-weight).neg_()
    return (coverage if field == "coverage" else coverage.mul_(weighted).div_(weight + 1e-8)).numpy()


def _parts(scene: GaussianScene, field: str) -> list[tuple[int, GaussianScene]]:
    """Scenes for the kernel of sums, whose Gaussians have a weight of 1 and as intensity what is to be summed: their
    own as seen from their own means, which is from no direction, or 1 − τ, per cm. For labels one scene each."""
    if field == "labels":
        return [(label, _weighing_one(part)) for label, part in label_parts(scene)]
    weighing = _weighing_one(scene)
    if field != "attenuation":
        return [(0, weighing)]
    constant = (scene.transmittances.detach().to("cpu", torch.float32) / (-4.0 * _SH_C0)).reshape(-1, 1, 1)
    info = replace(weighing.info, intensity="sigmoid")
    tensors: dict[str, Any] = {**weighing.splats, "sh0": constant}
    return [(0, GaussianScene(**tensors, info=info))]


def _weighing_one(scene: GaussianScene) -> GaussianScene:
    splats = {name: tensor.detach().to("cpu", torch.float32) for name, tensor in scene.splats.items()}
    certain = torch.full_like(splats["transmittances"], _CERTAIN)
    tensors: dict[str, Any] = {**splats, "transmittances": certain, "shN": splats["shN"][:, :0]}
    return GaussianScene(**tensors, info=replace(scene.info, sh_degree=0))


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
    write_whole(path, png_file(as_grey(pixels, field)) if is_picture else npy_bytes(pixels))


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
