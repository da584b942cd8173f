"""Import of checkpoints that the released UltraG-Ray trainer wrote (docs/physics.md §1, §2, §3, §6).

A released checkpoint holds the six raw parameter tensors and nothing about where they are: its unit is
the centimetre, its origin the mean of the image corners of the training frames, and its depth grid is
stretched by H/(H−1). The dataset it was trained on (conf.json, poses_train.npy, images_train.npy) says the
rest; the imported scene then answers poses in the tracker's own frame, in mm. The way back is `checkpoint_export`.
"""

from __future__ import annotations

import logging
import pickle
import re
import warnings
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ultragray.contract import checked_number, under
from ultragray.errors import CheckpointInvalid, InvalidArgument
from ultragray.files.poses import load_poses
from ultragray.interchange.released_config import ReleasedConfig, read_released_config, released_centre_mm
from ultragray.probe import FloatArray
from ultragray.scene import PARAMETERS, GaussianScene
from ultragray.scene_info import SceneInfo, Vector

_log = logging.getLogger(__name__)


def import_checkpoint(
    checkpoint: str | Path,
    *,
    config: str | Path,
    poses: str | Path | None = None,
    center_mm: Sequence[float] | None = None,  # x, y, z
    centered: bool = False,
    image_height: int | None = None,
) -> GaussianScene:
    """A released checkpoint (`ckpt_29999.pt`) as a scene of ours, float32 on the CPU.

    `config` is the dataset's conf.json. Where the scene lies comes from exactly one of: `poses`, the training
    poses (poses_train.npy or .json: [P, 4, 4] or [P, 3, 4], camera-to-world, mm), which the scene then also
    stores; `center_mm`, the scene centre in the tracker's frame; `centered`, which leaves poses relative to
    the centre. The height of the training images comes from `image_height`, from conf.json's own key of that name
    (which `export_checkpoint` writes), or from the images file that conf.json names. Raises CheckpointInvalid, naming
    the file and the reason; InvalidArgument for options that do not go together. The checkpoint is read with
    `weights_only=True`: it never runs code.
    """
    placements = {"poses": poses is not None, "center_mm": center_mm is not None, "centered": centered}
    given = [name for name, used in placements.items() if used]
    if len(given) != 1:
        raise InvalidArgument(
            "exactly one of poses (the training poses, from which the scene centre follows), center_mm (the "
            "centre in mm) and centered (poses relative to the centre) must be given, got "
            f"{' and '.join(given) or 'none'}",
            field="poses",
        )
    released = read_released_config(config)
    height, width = _image_size(released, image_height)
    training_poses = None if poses is None else _training_poses(poses, released)
    info = SceneInfo(
        centre_mm=_centre_mm(released, training_poses, center_mm),
        probe=released.probe(height),
        image_height=height,
        image_width=width,
        intensity="released",
        dataset_name=released.dataset_name,
        training={"imported_from": Path(checkpoint).name, "released_far_mm": released.released_probe.far_mm},
    )
    step, splats = _read_checkpoint(Path(checkpoint))
    if step is not None:
        info.training["step"] = step
    try:
        return GaussianScene.from_splats(splats, info=info, training_poses=training_poses)
    except InvalidArgument as error:
        raise CheckpointInvalid(f"{checkpoint}: {error}") from error


def _image_size(released: ReleasedConfig, image_height: int | None) -> tuple[int, int | None]:
    """Height and, where it is known, width of the training images."""
    if image_height is None and released.image_height is not None:
        return released.image_height, released.image_width
    if image_height is None:
        if released.images is None:
            raise InvalidArgument(
                "image_height must be given: a released depth grid depends on the height of "
                f"the training images, and {released.images_missing}",
                field="image_height",
            )
        return released.images.height, released.images.width
    with under("image_height"):
        checked_number(image_height, int, low=2)
    same = released.images is not None and released.images.height == image_height
    return image_height, released.images.width if released.images is not None and same else None


def _training_poses(path: str | Path, released: ReleasedConfig) -> FloatArray:  # [P, 4, 4] mm
    try:
        poses = load_poses(path)
    except InvalidArgument as error:
        raise CheckpointInvalid(str(error)) from error
    if released.images is not None and released.images.count != len(poses):
        _log.warning(
            "%s holds %d poses, %s holds %d images: the scene centre is right only for the training poses",
            path,
            len(poses),
            released.images.path,
            released.images.count,
        )
    return poses


def _centre_mm(
    released: ReleasedConfig, training_poses: FloatArray | None, center_mm: Sequence[float] | None
) -> Vector:
    """The origin of the released scene in the tracker's frame: the mean training image corner (§6)."""
    if training_poses is not None:
        return tuple(released_centre_mm(released.released_probe, training_poses).tolist())
    if center_mm is None:
        return (0.0, 0.0, 0.0)
    try:
        x, y, z = (checked_number(value, float) for value in center_mm)
    except (TypeError, ValueError):
        raise InvalidArgument(f"center_mm must be three finite numbers, got {center_mm!r}", field="center_mm") from None
    return (x, y, z)


def _read_checkpoint(path: Path) -> tuple[int | None, dict[str, Tensor]]:
    """The training step, where it is known, and the six raw tensors as float32."""
    document = _load_without_code(path)
    splats = document.get("splats", document) if isinstance(document, Mapping) else document
    if not isinstance(splats, Mapping):
        raise CheckpointInvalid(f"{path}: not a checkpoint of the released trainer: it holds a {type(splats).__name__}")
    missing = [name for name in PARAMETERS if name not in splats]
    if missing:
        raise CheckpointInvalid(
            f"{path}: not a checkpoint of the released trainer: its splats lack {', '.join(missing)}"
        )
    tensors = {name: splats[name] for name in PARAMETERS}
    _check_tensors(path, tensors)
    step = document.get("step") if splats is not document else None
    return step if type(step) is int else None, {
        name: tensor.detach().to(torch.float32).contiguous() for name, tensor in tensors.items()
    }


def _load_without_code(path: Path) -> Any:
    if not path.is_file():
        raise CheckpointInvalid(f"{path}: no such file")
    try:
        if _is_compressed(path):
            raise CheckpointInvalid(f"{path}: its entries are compressed, which torch.save never does")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch warns about old formats that it reads all the same
            return torch.load(path, map_location="cpu", weights_only=True)
    except CheckpointInvalid:
        raise
    except Exception as error:  # whatever a hostile file makes the reader raise is the file's fault
        raise CheckpointInvalid(f"{path}: {_why_unreadable(error)}") from error


def _is_compressed(path: Path) -> bool:
    """Tell whether the file could inflate to more than its own size."""
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist())


def _why_unreadable(error: Exception) -> str:
    text = str(error)
    if isinstance(error, pickle.UnpicklingError) and "eights only load failed" in text:
        name = re.search(r"(?:GLOBAL|global) ([A-Za-z_]\w*\.[\w.]+)", text)
        found = f" ({name.group(1).rstrip('.')})" if name else ""
        return f"refused, as it holds more than tensors and plain values and could run code{found}"
    if isinstance(error, RuntimeError):
        return f"truncated, or not a PyTorch checkpoint: {text.split('. ')[0].splitlines()[0][:200]}"
    return "truncated, or not a PyTorch checkpoint"


def _check_tensors(path: Path, tensors: Mapping[str, Any]) -> None:
    """Plain dense tensors that really lie in the file; shapes and values are checked with the scene."""
    total = 0
    for name, tensor in tensors.items():
        if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
            kind = str(tensor.dtype) if isinstance(tensor, Tensor) else type(tensor).__name__
            raise CheckpointInvalid(f"{path}: its {name} must be a floating tensor, got {kind}")
        if tensor.layout != torch.strided or tensor.device.type != "cpu" or tensor.is_quantized:
            raise CheckpointInvalid(f"{path}: its {name} must be a plain dense tensor")
        total += tensor.numel() * tensor.element_size()
    if total > path.stat().st_size:  # views with stride 0 claim any size
        raise CheckpointInvalid(f"{path}: its tensors claim {total} bytes, more than the file holds")
