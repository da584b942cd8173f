"""Labels in files: label maps in NIfTI-1, read by nibabel (extra `nifti`), and NRRD, and painted frames; and fields of
displacements in the same formats, and as transforms of ITK (of `.h5` by h5py, extra `hdf5`). Free of torch.

The reader of NRRD is ours, as that of sequences is (`ultragray.datasets.plus_files`): pynrrd inflates whatever a header
promises.
"""

from __future__ import annotations

import math
import re
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from ultragray.errors import ExtraMissing, InvalidArgument
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import FloatArray
from ultragray.installation import missing_extra
from ultragray.scene.info import MAX_LABEL, UNPAINTED

LABEL_MAP_SUFFIXES = (".nii", ".nii.gz", ".nrrd")
VECTOR_FIELD_SUFFIXES = (*LABEL_MAP_SUFFIXES, ".h5", ".tfm")
MAX_VOXELS = 2**28
_MAX_NRRD_HEADER_BYTES = 1 << 20
_NRRD_TYPES = {
    **dict.fromkeys(("uchar", "unsigned char", "uint8", "uint8_t"), "u1"),
    **dict.fromkeys(("signed char", "int8", "int8_t"), "i1"),
    **dict.fromkeys(("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"), "u2"),
    **dict.fromkeys(("short", "short int", "signed short", "signed short int", "int16", "int16_t"), "i2"),
    **dict.fromkeys(("int", "signed int", "int32", "int32_t"), "i4"),
    **dict.fromkeys(("uint", "unsigned int", "uint32", "uint32_t"), "u4"),
    **{"float": "f4", "double": "f8"},
}
_TO_RAS = {  # by the words of `space`
    **dict.fromkeys(("right-anterior-superior", "ras"), (1.0, 1.0, 1.0)),
    **dict.fromkeys(("left-anterior-superior", "las"), (-1.0, 1.0, 1.0)),
    **dict.fromkeys(("left-posterior-superior", "lps"), (-1.0, -1.0, 1.0)),
}
_MM_PER_UNIT = {"unknown": 1.0, "mm": 1.0, "meter": 1e3, "micron": 1e-3}  # of NIfTI, by nibabel's words
_TRANSFORM_PARAMETERS = ("FixedParameters", "Parameters")
_GRID_TRANSFORM = re.compile(r"(Inverse)?DisplacementFieldTransform_(float|double)_3_3")  # the inverse is Slicer's
_ZLIB_OR_GZIP = 47  # zlib's window bits for either kind of header


class LabelMap(NamedTuple):
    """A volume of labels and where it lies."""

    volume: npt.NDArray[np.uint8]  # [I, J, K], 0: no label
    affine: FloatArray  # [4, 4] voxels to mm


def read_label_map(path: str | Path) -> LabelMap:
    """The labels of a NIfTI or NRRD file, in mm of its own frame, right-anterior-superior (RAS+).

    Raises InvalidArgument for what is no such file, no volume, more than MAX_VOXELS, or not whole numbers from 0 to
    255; ExtraMissing where nibabel is needed and not installed.
    """
    values, affine = read_volume(path, field="label_map")
    if not (values.dtype.kind in "iuf" and (values >= 0).all() and (values <= MAX_LABEL).all()):
        range_words = f", it holds {values.min():g} to {values.max():g}" if values.dtype.kind in "iuf" else ""
        raise InvalidArgument(f"label_map must hold numbers from 0 to {MAX_LABEL}{range_words}", field="label_map")
    volume = values.astype(np.uint8)
    if not np.array_equal(volume, values):
        raise InvalidArgument("label_map must hold whole numbers: labels cannot be interpolated", field="label_map")
    return LabelMap(volume, affine)


def read_volume(path: str | Path, *, field: str) -> tuple[npt.NDArray[Any], FloatArray]:  # [I, J, K], [4, 4]
    """The values of a NIfTI or NRRD file, and the way from its voxels to mm, RAS+. Raises as `read_label_map`."""
    values, affine, _ = _read(path, field, vectors=False)
    return values, affine


class VectorField(NamedTuple):
    """Displacements at the voxels of a volume, both in mm of the file's own frame, RAS+."""

    vectors: FloatArray  # [I, J, K, 3]
    affine: FloatArray  # [4, 4] voxels to mm


VECTOR_AXES = ("ras", "lps")
_INTENT_DISPLACEMENT = 1006  # of NIfTI-1: vectors that are in the axes of its coordinates, RAS+


def read_vector_field(path: str | Path, axes: str | None = None, *, field: str = "field") -> VectorField:
    """The displacements of a NIfTI file [I, J, K, 3] or [I, J, K, 1, 3], an NRRD file, or a grid transform of ITK.

    `axes`, of VECTOR_AXES: of the numbers of a vector. NRRD says it, and NIfTI whose intent is a displacement;
    transforms are in LPS. ITK and ANTs write NIfTI of the intent "vector", in LPS, which does not say it: there it must
    be given. Raises as `read_label_map`, and InvalidArgument where the axes are not known, or given otherwise than the
    file says, and for other transforms than one grid.
    """
    values, affine, own_axes = _read(path, field, vectors=True)
    if axes is None and own_axes is None:
        raise InvalidArgument(
            f"{Path(path).name} does not say in which axes its vectors are: {' or '.join(VECTOR_AXES)} must be given "
            "(ITK, ANTs and Slicer write lps)",
            field="field_axes",
        )
    to_ras = _TO_RAS[axes or own_axes or ""]
    if own_axes is not None and _TO_RAS[own_axes] != to_ras:
        raise InvalidArgument(f"{Path(path).name} says that its vectors are {own_axes}, not {axes}", field="field_axes")
    vectors: FloatArray = values.astype(np.float64) * to_ras
    if not np.isfinite(vectors).all():
        raise InvalidArgument(f"{Path(path).name} must hold finite numbers", field=field)
    return VectorField(vectors, affine)


_Read: TypeAlias = tuple[npt.NDArray[Any], FloatArray, str | None]  # values, voxels to mm (RAS+), axes of the vectors


def _read(path: str | Path, field: str, *, vectors: bool) -> _Read:
    path = Path(path)
    suffixes = VECTOR_FIELD_SUFFIXES if vectors else LABEL_MAP_SUFFIXES
    if not path.name.endswith(suffixes):
        *most, last = suffixes
        raise InvalidArgument(f"{field} must end in {', '.join(most)} or {last}, got {path.name!r}", field=field)
    others = {".nrrd": ("NRRD", _read_nrrd), ".h5": ("HDF5", _read_hdf5), ".tfm": ("a transform", _read_tfm)}
    kind, read = others.get(path.suffix, ("NIfTI", _read_nifti))
    try:
        return read(path, field, vectors)
    except (InvalidArgument, ExtraMissing):
        raise
    except Exception as error:  # nibabel raises whatever the reading of a damaged file meets
        reason = str(error).replace(str(path), path.name)  # not where a service keeps it
        raise InvalidArgument(f"{path.name} cannot be read as {kind}: {reason}", field=field) from None


def _read_nifti(path: Path, field: str, vectors: bool) -> _Read:
    try:
        import nibabel
    except ImportError as error:
        raise missing_extra(error, "reading NIfTI", field=field) from error
    image: Any = nibabel.load(path)
    shape = tuple(side for place, side in enumerate(image.shape) if place < 3 or side != 1)
    _check_volume(shape, field, vectors)
    header, affine = image.header, np.array(image.affine, np.float64)
    if not (header["qform_code"] or header["sform_code"]):
        raise InvalidArgument(
            f"{path.name} does not say where it lies, nor which side is left: its qform_code and sform_code are 0",
            field=field,
        )
    unit, _ = header.get_xyzt_units()
    if vectors and _MM_PER_UNIT[unit] != 1.0:
        raise InvalidArgument(f"{path.name} must be in mm, its lengths are in {unit}", field=field)
    affine[:3] *= _MM_PER_UNIT[unit]
    axes = "ras" if int(header["intent_code"]) == _INTENT_DISPLACEMENT else None
    return np.asanyarray(image.dataobj).reshape(shape), affine, axes


def _check_volume(shape: Sequence[int], field: str, vectors: bool) -> None:
    if len(shape) != 3 + vectors or shape[3:] not in ((), (3,)) or not 0 < math.prod(shape) <= MAX_VOXELS:
        what = "a volume of three numbers a voxel" if vectors else "one volume"
        raise InvalidArgument(
            f"{field} must be {what}, of at most {MAX_VOXELS:,} numbers, it is {list(shape)}", field=field
        )


def _read_nrrd(path: Path, field: str, vectors: bool) -> _Read:
    """Raises ValueError, KeyError, OSError, zlib.error for another file than of one volume, raw or gzip."""
    data = path.read_bytes()
    end = re.search(rb"\r?\n\r?\n", data[:_MAX_NRRD_HEADER_BYTES])
    if not data.startswith(b"NRRD000") or end is None:
        raise ValueError("it does not begin as one does")
    head, body = data[: end.start()].decode("utf-8", errors="replace"), data[end.end() :]
    lines = (line.partition(": ") for line in head.splitlines()[1:])
    fields = {key.lower(): value.strip() for key, colon, value in lines if colon}
    sizes = [int(size) for size in fields["sizes"].split()]
    directions = re.findall(r"none|\([^)]*\)", fields["space directions"])
    last = directions.index("none") if vectors and "none" in directions else len(sizes) - 1  # axis of the vectors
    _check_volume((*sizes[:last], *sizes[last + 1 :], sizes[last]), field, vectors)
    encoding, dtype = fields["encoding"].lower(), np.dtype(_NRRD_TYPES[fields["type"].lower()])
    if encoding not in ("raw", "gzip", "gz") or "data file" in fields or "datafile" in fields:
        raise ValueError(f"its voxels must be in it, raw or gzip, they are {encoding}")
    expected = dtype.itemsize * math.prod(sizes)
    voxels = body if encoding == "raw" else zlib.decompressobj(_ZLIB_OR_GZIP).decompress(body, expected)
    if len(voxels) < expected:
        raise ValueError(f"truncated: it holds {len(voxels)} of {expected} bytes")
    order: Literal["<", ">"] = ">" if fields.get("endian", "little").lower() == "big" else "<"
    values = np.frombuffer(voxels[:expected], dtype.newbyteorder(order)).reshape(sizes, order="F")
    units = set(re.findall(r'"([^"]+)"', fields.get("space units", ""))) - {"mm", "millimeter"}
    if units:
        raise ValueError(f"its space units must be mm, they are {', '.join(sorted(units))}")
    space, affine = fields["space"].lower(), np.eye(4)
    affine[:3] = (_vectors_in(f"{fields['space directions']} {fields['space origin']}") * _TO_RAS[space]).T
    if vectors:
        values = np.moveaxis(values, last, -1)
        if "measurement frame" in fields:  # the axes of the vectors, in those of `space`
            values = values @ _vectors_in(fields["measurement frame"])
    return values, affine, space


def _read_hdf5(path: Path, field: str, _: bool) -> _Read:
    try:
        import h5py
    except ImportError as error:
        raise missing_extra(error, "reading transforms", field=field) from error
    with h5py.File(path, "r") as file:
        transforms = list(file["TransformGroup"].values())
        _check_grid([one["TransformType"].asstr()[0] for one in transforms], field)
        (one,) = transforms
        # ITK before 5 wrote "Tranform"
        fixed, vectors = (one.get(f"Transform{name}") or one[f"Tranform{name}"] for name in _TRANSFORM_PARAMETERS)
        if any(one.file != file or one.is_virtual or one.external for one in (fixed, vectors)):
            raise ValueError("its parameters must lie in the file itself")
        return _grid(fixed, vectors, field)


def _read_tfm(path: Path, field: str, _: bool) -> _Read:
    lines = (line.partition(": ") for line in path.read_text(encoding="utf-8").splitlines())
    pairs = [(key, value.strip()) for key, colon, value in lines if colon]
    _check_grid([value for key, value in pairs if key == "Transform"], field)
    fixed, vectors = (np.array(dict(pairs)[name].split(), np.float64) for name in _TRANSFORM_PARAMETERS)
    return _grid(fixed, vectors, field)


def _check_grid(kinds: Sequence[str], field: str) -> None:
    if len(kinds) != 1 or _GRID_TRANSFORM.fullmatch(kinds[0]) is None:
        raise InvalidArgument(
            f"{field} must be one grid transform (DisplacementFieldTransform_double_3_3), it is "
            f"{', '.join(kinds) or 'none'}: Slicer's module Transforms converts others",
            field=field,
        )


def _grid(fixed: Any, vectors: Any, field: str) -> _Read:  # [18], [3·I·J·K]
    """A grid by its size, origin, spacing, and direction row by row; and its vectors, x fastest. All is in LPS."""
    size, origin, spacing, direction = np.split(np.asarray(fixed, np.float64), [3, 6, 9])
    i, j, k = size.astype(int).tolist()
    _check_volume((i, j, k, 3), field, vectors=True)
    if vectors.shape != (3 * i * j * k,):
        raise ValueError(f"it holds {vectors.size} of {3 * i * j * k} numbers")
    affine = np.eye(4)
    affine[:3] = np.column_stack([direction.reshape(3, 3) * spacing, origin]) * np.array(_TO_RAS["lps"])[:, None]
    return np.asarray(vectors, np.float64).reshape(k, j, i, 3).transpose(2, 1, 0, 3), affine, "lps"


def _vectors_in(text: str) -> FloatArray:  # [N, 3]
    return np.array([[float(value) for value in one.split(",")] for one in re.findall(r"\(([^)]*)\)", text)])


PAINTED_SUFFIX = ".npz"


class PaintedFrames(NamedTuple):
    """Frames that somebody painted on, in their order."""

    poses: FloatArray  # [C, 4, 4] mm, probe to scene
    labels: npt.NDArray[np.uint8]  # [C, H, W], 0: no label, 255: not painted


def read_painted(path: str | Path) -> PaintedFrames:
    """The arrays `poses` and `labels` of a .npz file, as `ultragray render --outputs labels` writes it.

    Raises InvalidArgument, naming the file; InvalidPose.
    """
    path = Path(path)
    if path.suffix != PAINTED_SUFFIX:
        raise InvalidArgument(f"painted frames must end in {PAINTED_SUFFIX}, got {path.name!r}", field="frames")
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            poses, labels = arrays["poses"], arrays["labels"]
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise InvalidArgument(
            f"{path} must be a .npz file with the arrays poses and labels: {error}", field="frames"
        ) from None
    exact = check_poses(poses)
    is_whole = labels.dtype.kind in "iuf" and ((labels >= 0) & (labels <= UNPAINTED) & (labels % 1 == 0)).all()
    if labels.ndim != 3 or len(labels) != len(exact) or not is_whole:
        raise InvalidArgument(
            f"labels of {path.name} must be whole numbers [{len(exact)}, H, W] from 0 to 255, got {labels.dtype} "
            f"{list(labels.shape)}",
            field="frames",
        )
    return PaintedFrames(exact, labels.astype(np.uint8))


def parse_names(text: str) -> dict[int, str]:
    """Names of labels from text such as "1=bone,2=muscle". Raises InvalidArgument."""
    try:
        pairs = [pair.split("=", 1) for pair in text.split(",") if pair.strip()]
        return {int(label): name.strip() for label, name in pairs}
    except ValueError:
        raise InvalidArgument(f'names must be such as "1=bone,2=muscle", got {text!r}', field="names") from None
