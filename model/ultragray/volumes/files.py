"""Slices as pictures; volumes as NIfTI-1 (.nii, .nii.gz) and NRRD (.nrrd), written slab by slab.

The same volume is the same bytes.

Both formats say that their axes are right, anterior and superior (RAS+), which programs for patients expect. A scene
knows no patient: its frame's x, y and z are written as these three, with unchanged numbers, as 3D Slicer takes the
poses that arrive over OpenIGTLink. A program that shows LPS coordinates, such as ITK, negates the first two.
"""

from __future__ import annotations

import gzip
import io
import struct
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from ultragray.display.pixels import image_file
from ultragray.errors import InvalidArgument
from ultragray.files.atomic import atomic_path, write_whole
from ultragray.scene import GaussianScene
from ultragray.scene_info import SceneInfo
from ultragray.volumes.fields import sample_slice, sample_volume
from ultragray.volumes.grid import VolumeGrid
from ultragray.volumes.names import SLICE_SUFFIXES, VOLUME_SUFFIXES

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
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        if suffix == ".nrrd":
            file.write(_nrrd_header(field, grid, scene.info.label_names))
            _write_compressed(file, b"", slabs, after_slab)
        elif suffix == ".nii":
            file.write(_nifti_header(field, grid))
            _write_slabs(file, slabs, after_slab)
        else:
            _write_compressed(file, _nifti_header(field, grid), slabs, after_slab)


def write_slice(path: str | Path, scene: GaussianScene, field: str, grid: VolumeGrid) -> None:
    """Write a field on a plane (`sample_slice`) as .npy, or as a grey .png, whole or not at all.

    A PNG is 255 at 1, of attenuation at the largest value of the slice; labels keep their numbers. Raises
    InvalidArgument for another name and what `sample_slice` raises; OSError.
    """
    path = Path(path)
    if path.suffix not in SLICE_SUFFIXES:
        raise InvalidArgument(f"a slice must end in {', '.join(SLICE_SUFFIXES)}, got {path.name!r}", field="output")
    pixels = sample_slice(scene, field, grid)
    if path.suffix == ".npy":
        data = io.BytesIO()
        np.save(data, pixels)
        write_whole(path, data.getvalue())
        return
    write_whole(path, image_file(as_grey(pixels, field), ".png").tobytes())


def as_grey(pixels: npt.NDArray[Any], field: str) -> npt.NDArray[Any]:  # [J, I] -> [J, I]
    """A slice as a picture shows it: white is 1, of attenuation its largest value; labels keep their numbers."""
    return pixels / pixels.max() if field == "attenuation" and pixels.any() else pixels


def volume_facts(info: SceneInfo, field: str, grid: VolumeGrid) -> dict[str, Any]:
    """The place of a volume or a slice and the meaning of its values, for JSON."""
    names = {str(number): name for number, name in info.label_names.items()} if field == "labels" else {}
    shape, affine = list(grid.shape), grid.affine.tolist()
    return {"field": field, "shape": shape, "spacing_mm": grid.spacing_mm, "affine": affine, "label_names": names}


def _write_compressed(
    file: BinaryIO,
    begin: bytes,
    slabs: Iterable[npt.NDArray[np.generic]],
    after_slab: Callable[[int], object] | None,
) -> None:
    with gzip.GzipFile("", "wb", _COMPRESSION, file, mtime=0) as packed:
        packed.write(begin)
        _write_slabs(packed, slabs, after_slab)


def _write_slabs(
    file: BinaryIO | gzip.GzipFile,
    slabs: Iterable[npt.NDArray[np.generic]],
    after_slab: Callable[[int], object] | None,
) -> None:
    done = 0
    for slab in slabs:
        file.write(slab.astype(slab.dtype.newbyteorder("<"), copy=False).tobytes())
        done += len(slab)
        if after_slab is not None:
            after_slab(done)


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
    directions = " ".join(_nrrd_vector(axis * grid.spacing_mm) for axis in grid.axes)
    lines = [
        "NRRD0005",
        f"content: UltraG-Ray {field}",
        f"type: {'uint8' if field == 'labels' else 'float'}",
        "dimension: 3",
        "space: right-anterior-superior",
        f"sizes: {' '.join(map(str, grid.shape))}",
        f"space directions: {directions}",
        "kinds: domain domain domain",
        'space units: "mm" "mm" "mm"',
        f"space origin: {_nrrd_vector(grid.origin_mm)}",
        "endian: little",
        "encoding: gzip",
    ]
    if field == "labels":
        lines += [f"label {number}:={_one_line(name)}" for number, name in sorted(label_names.items())]
    return ("\n".join(lines) + "\n\n").encode()


def _nrrd_vector(vector: npt.NDArray[np.float64]) -> str:
    return "(" + ",".join(repr(float(value)) for value in vector) + ")"


def _one_line(text: str) -> str:
    return text.replace("\\", "\\\\").replace("\n", "\\n")
