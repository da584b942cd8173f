"""Scans of the TUS-REC challenges: an .h5 file of frames and tracked transforms, and their calibration.

`frames` is uint8 [N, H, W], `tforms` [N, 4, 4] leads from the tool on the probe to the camera, mm. `calib_matrix.csv`,
beside the scan or in a folder above it, has two named matrices: from pixels to mm, and on to the tool. Its pixels are
counted from 1. The extra `hdf5`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ultragray.datasets.fan import parse_matrix, tracked_sweep
from ultragray.datasets.images import MAX_PIXEL_BYTES, grey_frames
from ultragray.datasets.released import no_pose_note
from ultragray.errors import DatasetInvalid, InvalidArgument
from ultragray.exchange.poses import frames_with_pose
from ultragray.geometry.probe import FloatArray
from ultragray.installation import missing_extra
from ultragray.learn.sweep import Chain, Link, Sweep, check_frame_poses, parse_frame_ranges

CALIBRATION = "calib_matrix.csv"
FOLDERS_ABOVE = 3  # frames_transfs/000/RH_Par_L_DtP.h5
MAX_CALIBRATION_BYTES = 1 << 20


def read_tusrec_sweep(
    path: Path,
    *,
    frames: str | None = None,
    crop: str | None = None,
    fan: str | None = None,
    calibration: Path | None = None,
) -> tuple[Sweep, int]:
    """The frames of a scan that have a pose, and how many it has.

    `frames`, `crop` and `fan` as of a DICOM loop. Raises DatasetInvalid, naming the file and the reason;
    InvalidArgument for options that do not fit; ExtraMissing without h5py.
    """
    found = calibration or _calibration_near(path)
    to_mm, to_tool = _read_calibration(found)
    from_one = np.eye(4)
    from_one[:2, 3] = 1.0  # pixel (1, 1) is the first
    image_to_tool = to_tool @ to_mm @ from_one
    stored, tforms, count = _read_scan(path, frames)
    numbers = np.arange(count) if frames is None else np.array(parse_frame_ranges(frames, count, option="frames"))
    known = frames_with_pose(tforms)
    notes = no_pose_note(numbers[known], count, path) if frames is None else ()
    stored, numbers, tforms = stored[known], numbers[known], check_frame_poses(tforms[known], numbers[known], str(path))
    chain = Chain(
        (
            Link("pixels from 1", "image in mm", "scaling_from_pixel_to_mm", found.name),
            Link("image in mm", "tool", "spatial_calibration", found.name),
            Link("tool", "camera", "tforms", path.name, is_tracked=True),
        )
    )
    sweep = tracked_sweep(
        grey_frames(stored, str(path)),
        tforms,
        image_to_tool,
        numbers,
        path,
        crop=crop,
        fan=fan,
        calibration=str(found),
        chain=chain,
        notes=notes,
    )
    return sweep, count


def _calibration_near(path: Path) -> Path:
    for folder in [path.parent, *path.resolve().parents[1 : 1 + FOLDERS_ABOVE]]:
        if (folder / CALIBRATION).is_file():
            return folder / CALIBRATION
    raise DatasetInvalid(
        f"{path}: its calibration {CALIBRATION} must lie beside it, in a folder above it, or be named with calibration"
    )


def _read_calibration(path: Path) -> tuple[FloatArray, FloatArray]:  # [4, 4] both
    """From pixels, counted from 1, to mm, and from there to the tool. Raises DatasetInvalid."""
    if not path.is_file() or path.stat().st_size > MAX_CALIBRATION_BYTES:
        raise DatasetInvalid(f"{path}: no calibration: it is missing, or too large")
    blocks: dict[str, list[str]] = {}
    name = ""
    for line in path.read_text(encoding="utf-8-sig", errors="replace").splitlines():
        words = [word.strip() for word in line.split(",") if word.strip()]
        if words and words[0][:1].isalpha():
            name = words[0]
        else:
            blocks.setdefault(name, []).extend(words)
    found = []
    for begin in ("scaling", "spatial_calibration"):
        text = next((" ".join(numbers) for key, numbers in blocks.items() if key.lower().startswith(begin)), None)
        if text is None:
            raise DatasetInvalid(f"{path}: it has no matrix whose name begins with {begin}")
        found.append(parse_matrix(text, f"{path}: {begin}"))
    return found[0], found[1]


def _read_scan(path: Path, frames: str | None) -> tuple[np.ndarray, FloatArray, int]:
    """The chosen frames and their transforms [N, 4, 4], and the number of all."""
    try:
        import h5py
    except ImportError as error:
        raise missing_extra(error, "a scan of TUS-REC") from error
    try:
        with h5py.File(path, "r") as file:
            images, tforms = (file.get(key) for key in ("frames", "tforms"))
            if not all(isinstance(one, h5py.Dataset) for one in (images, tforms)):
                raise DatasetInvalid(f"{path}: it must have frames and tforms, it has {', '.join(file) or 'nothing'}")
            links = (file.get(key, getlink=True) for key in ("frames", "tforms"))
            if any(type(link) is not h5py.HardLink for link in links) or any(
                one.is_virtual or one.external for one in (images, tforms)
            ):
                raise DatasetInvalid(f"{path}: its frames and tforms must lie in the file itself")
            count = len(images) if images.ndim else 0
            if tforms.shape != (count, 4, 4) or tforms.dtype.kind != "f":
                raise DatasetInvalid(
                    f"{path}: tforms must be numbers [{count}, 4, 4], got {tforms.dtype} {list(tforms.shape)}"
                )
            if not count:
                raise DatasetInvalid(f"{path}: it holds no frames, its frames are {list(images.shape)}")
            numbers = range(count) if frames is None else parse_frame_ranges(frames, count, option="frames")
            if images.dtype != np.uint8:
                raise DatasetInvalid(f"{path}: frames must be uint8, got {images.dtype} {list(images.shape)}")
            if images.size * len(numbers) > MAX_PIXEL_BYTES * count:
                raise DatasetInvalid(
                    f"{path}: frames must have at most {MAX_PIXEL_BYTES >> 30} GiB, got {list(images.shape)}: choose "
                    "some with frames"
                )
            chosen = slice(None) if frames is None else numbers
            return images[chosen], np.asarray(tforms[chosen], np.float64), count
    except (OSError, RuntimeError, ValueError, KeyError) as error:
        if isinstance(error, (DatasetInvalid, InvalidArgument)):
            raise
        raise DatasetInvalid(f"{path}: it cannot be read as HDF5: {error}") from error
