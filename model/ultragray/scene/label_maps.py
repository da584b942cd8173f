"""Labels in files: NIfTI-1 label maps, read by nibabel (extra `nifti`), and painted frames. Free of torch."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ultragray.errors import InvalidArgument
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import FloatArray
from ultragray.installation import missing_extra
from ultragray.scene.info import MAX_LABEL, UNPAINTED

LABEL_MAP_SUFFIXES = (".nii", ".nii.gz")
MAX_VOXELS = 2**28


class LabelMap(NamedTuple):
    """A volume of labels and where it lies."""

    volume: npt.NDArray[np.uint8]  # [I, J, K], 0: no label
    affine: FloatArray  # [4, 4] voxels to mm


def read_label_map(path: str | Path) -> LabelMap:
    """The labels of a NIfTI file, in mm of its own frame, right-anterior-superior (RAS+).

    Raises InvalidArgument for what is no NIfTI file, no volume, more than MAX_VOXELS, or not whole numbers from 0 to
    255; ExtraMissing where nibabel is not installed.
    """
    path = Path(path)
    if not path.name.endswith(LABEL_MAP_SUFFIXES):
        expected = " or ".join(LABEL_MAP_SUFFIXES)
        raise InvalidArgument(f"a label map must end in {expected}, got {path.name!r}", field="label_map")
    try:
        import nibabel
    except ImportError as error:
        raise missing_extra(error, "reading label maps", field="label_map") from error
    try:
        image: Any = nibabel.load(path)
        shape = tuple(side for place, side in enumerate(image.shape) if place < 3 or side != 1)
        if len(shape) != 3 or not 0 < np.prod(shape, dtype=np.float64) <= MAX_VOXELS:
            raise InvalidArgument(
                f"label_map must be a volume of at most {MAX_VOXELS:,} voxels, it is {list(image.shape)}",
                field="label_map",
            )
        values = np.asanyarray(image.dataobj).reshape(shape)
    except InvalidArgument:
        raise
    except Exception as error:  # nibabel raises whatever the reading of a damaged file meets
        reason = str(error).replace(str(path), path.name)  # not where a service keeps it
        raise InvalidArgument(f"{path.name} cannot be read as NIfTI: {reason}", field="label_map") from None
    if not (values.dtype.kind in "iuf" and (values >= 0).all() and (values <= MAX_LABEL).all()):
        raise InvalidArgument(f"label_map must hold numbers from 0 to {MAX_LABEL}", field="label_map")
    volume = values.astype(np.uint8)
    if not np.array_equal(volume, values):
        raise InvalidArgument("label_map must hold whole numbers: labels cannot be interpolated", field="label_map")
    return LabelMap(volume, np.asarray(image.affine, np.float64))


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
