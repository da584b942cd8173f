"""Checkpoints of the released UltraG-Ray trainer, both ways (docs/physics.md §1, §2, §3, §6).

A released checkpoint holds the six raw parameter tensors and nothing about where they are: its unit is the centimetre,
its origin the mean of the image corners of the training frames, and its depth grid is stretched by H/(H−1). The dataset
it was trained on (conf.json, poses_train.npy, images_train.npy) says the rest; the imported scene then answers poses in
the tracker's own frame, in mm. First the import, then the fit of the released intensity, then the export.
"""

from __future__ import annotations

import io
import json
import logging
import math
import pickle
import re
import warnings
import zipfile
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ultragray.contract import checked_number, under
from ultragray.errors import CheckpointInvalid, InvalidArgument, InvalidProbe
from ultragray.exchange.poses import load_poses
from ultragray.exchange.released_config import (
    WIDTH_KEY,
    ReleasedConfig,
    probe_keys,
    read_released_config,
    released_centre_mm,
)
from ultragray.files import npy_bytes, write_whole
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.rendering.backends.reference import spherical_harmonics
from ultragray.scene.gaussians import PARAMETERS, GaussianScene
from ultragray.scene.info import SceneInfo, Vector

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
    names = [name for name, used in placements.items() if used]
    if len(names) != 1:
        raise InvalidArgument(
            "exactly one of poses (the training poses, from which the scene centre follows), center_mm (the "
            "centre in mm) and centered (poses relative to the centre) must be given, got "
            f"{' and '.join(names) or 'none'}",
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
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                stored = [entry.compress_type == zipfile.ZIP_STORED for entry in archive.infolist()]
            if not all(stored):  # it could inflate to more than its own size
                raise CheckpointInvalid(f"{path}: its entries are compressed, which torch.save never does")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch warns about old formats that it reads all the same
            return torch.load(path, map_location="cpu", weights_only=True)
    except CheckpointInvalid:
        raise
    except Exception as error:  # whatever a hostile file makes the reader raise is the file's fault
        raise CheckpointInvalid(f"{path}: {_why_unreadable(error)}") from error


def _why_unreadable(error: Exception) -> str:
    text = str(error)
    if isinstance(error, pickle.UnpicklingError) and "eights only load failed" in text:
        name = re.search(r"(?:GLOBAL|global) ([A-Za-z_]\w*\.[\w.]+)", text)
        detail = f" ({name.group(1).rstrip('.')})" if name else ""
        return f"refused, as it holds more than tensors and plain values and could run code{detail}"
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


# A `sigmoid` scene's echo intensities in the activation of the released code (docs/physics.md §2), as well as it can.
#
# The released activation I = min(max(h + 1, 0.5), 0.999) knows no intensity under 0.5, `sigmoid` I = 1/(1 +
# exp(−4·h)) does. For each Gaussian the coefficients of h are fitted anew, at the scene's own degree, to what the
# released code can show.

LOWEST, HIGHEST = 0.5, 0.999
MAX_TRAINING_VIEWS = 32
SPHERE_DIRECTIONS = 64
SPHERE_WEIGHT = 1e-3  # where poses say from where a Gaussian was seen; keeps the fit determined, and calm elsewhere
GAUSSIANS_PER_CHUNK = 8192


@dataclass(frozen=True)
class ReleasedIntensity:
    """Coefficients for the released activation, and how far the intensities they give are from the scene's own.

    Errors are over all Gaussians and the directions of the training views, or all directions where there are none.
    """

    sh0: Tensor  # [N, 1, 1]
    shN: Tensor  # [N, K-1, 1]  # noqa: N815 (the released name)
    largest_error: float
    mean_error: float


@torch.no_grad()
def fit_released_intensity(scene: GaussianScene) -> ReleasedIntensity:
    """Least squares over the directions from the training poses (at most 32 of them) to each Gaussian."""
    count, degree = scene.gaussian_count, scene.sh_degree
    coefficients = torch.cat([scene.sh0, scene.shN], dim=1)[..., 0].double()  # [N, K]
    fitted = torch.empty_like(coefficients)
    index = torch.arange(SPHERE_DIRECTIONS, dtype=torch.float64)  # of evenly spread directions, a Fibonacci lattice
    z, angle = 1.0 - (2.0 * index + 1.0) / SPHERE_DIRECTIONS, math.pi * (1.0 + math.sqrt(5.0)) * index
    radius = torch.sqrt(1.0 - z.square())
    directions = torch.stack([radius * torch.cos(angle), radius * torch.sin(angle), z], dim=-1)
    sphere = spherical_harmonics(directions, degree)  # [F, K]
    poses = scene.poses_to_scene_cm(scene.training_poses)
    chosen = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), MAX_TRAINING_VIEWS)).round().astype(int))
    origins = torch.from_numpy(poses[chosen, :3, 3])  # [V, 3]
    largest, total, terms = 0.0, 0.0, 0
    for start in range(0, count, GAUSSIANS_PER_CHUNK):
        ids = slice(start, start + GAUSSIANS_PER_CHUNK)
        own = coefficients[ids]  # [n, K]
        offsets = scene.means[ids].double()[:, None] - origins  # [n, V, 3]
        seen = spherical_harmonics(torch.nn.functional.normalize(offsets, dim=-1), degree)  # [n, V, K]
        everywhere = sphere.expand(len(own), -1, -1)  # [n, F, K]
        basis = torch.cat([seen, everywhere], dim=1)
        weights = torch.ones(basis.shape[1], dtype=torch.float64)
        if len(origins):
            weights[len(origins) :] = SPHERE_WEIGHT * len(origins) / SPHERE_DIRECTIONS
        wanted = torch.sigmoid(4.0 * torch.einsum("nmk,nk->nm", basis, own))
        weighted = basis * weights[:, None]
        normal = torch.einsum("nmk,nml->nkl", weighted, basis)
        target = torch.einsum("nmk,nm->nk", weighted, wanted.clamp(LOWEST, HIGHEST) - 1.0)
        fitted[ids] = torch.linalg.solve(normal, target)
        compared = seen if len(origins) else everywhere
        values = (torch.einsum("nmk,nk->nm", compared, fitted[ids]) + 1.0).clamp(LOWEST, HIGHEST)
        errors = (values - wanted[:, : compared.shape[1]]).abs()
        largest = max(largest, float(errors.max()))
        total, terms = total + float(errors.sum()), terms + errors.numel()
    parameters = fitted.to(scene.sh0.dtype)[..., None]
    return ReleasedIntensity(parameters[:, :1], parameters[:, 1:], largest, total / max(terms, 1))


# Export to the checkpoint format of the released UltraG-Ray code: the way back of `checkpoint`.
#
# The checkpoint holds what the released trainer saves and its viewer loads: step, global_tic and the six raw tensors
# (docs/physics.md §2). What it cannot say lies beside it as the released dataset layout has it: conf.json (planes and
# width in cm, on the released depth grid, §3) and poses_train.npy (mm). The released code puts the origin at the mean
# image corner of those poses (§6), so the Gaussians are moved there: a pose in the tracker's frame shows the same.

CONFIG_NAME = "conf.json"
POSES_NAME = "poses_train.npy"
SPLATS = ("means", "quats", "scales", "sh0", "shN", "transmittances")  # in the order of the released files


@dataclass(frozen=True)
class CheckpointExport:
    """The files that an export wrote, the place of its Gaussians' origin in the tracker's frame, and what was lost."""

    files: tuple[Path, ...]
    centre_mm: Vector
    notes: tuple[str, ...]  # a sentence each; none: the released code shows what we show
    largest_intensity_error: float  # of a `sigmoid` scene's intensities in [0, 1]; 0 for a `released` one


def export_checkpoint(scene: GaussianScene, checkpoint: str | Path, *, replace: bool = False) -> CheckpointExport:
    """Write `checkpoint` (`ckpt_29999.pt`) and, beside it, conf.json and poses_train.npy.

    The folder is made where only it is missing. conf.json needs the scene's probe, poses_train.npy its training poses;
    what is left out for want of them is in the notes, and so is how well the released activation fits a `sigmoid`
    scene. Raises InvalidArgument where a conf.json or poses_train.npy of something else lies there already, unless
    `replace` allows it, and for a scene of images with one row, which the released depth grid does not have; OSError.
    """
    checkpoint = Path(checkpoint)
    notes: list[str] = []
    beside: dict[str, bytes] = {}
    centre_mm = scene.info.centre_mm
    at = "({:.6g}, {:.6g}, {:.6g}) mm".format(*centre_mm)
    if scene.info.probe is None:
        notes.append(f"no {CONFIG_NAME}: the scene does not know its probe; poses are relative to its centre, {at}")
    else:
        released_probe, height, width = _released_view(scene)
        beside[CONFIG_NAME] = _config(released_probe, height, width, scene.sh_degree)
        if WIDTH_KEY not in probe_keys(released_probe):
            notes.append(f"the released trainer knows linear probes only: it does not read this {CONFIG_NAME}")
        if len(scene.training_poses):
            centre_mm = tuple(released_centre_mm(released_probe, scene.training_poses).tolist())
            beside[POSES_NAME] = npy_bytes(scene.training_poses)
        else:
            notes.append(f"no {POSES_NAME}: the scene has no training poses; poses are relative to its centre, {at}")
    if scene.labels is not None:
        notes.append("its labels are left out: the released format has none")
    if scene.info.beam is not None:
        notes.append(
            "its beam is left out: the released code cuts a plane, and shows slices of 0 mm where ours are "
            f"{scene.info.beam.thickness_mm:.3g} mm thick or more"
        )
    splats, largest_error = _splats(scene, centre_mm, notes)
    folder = checkpoint.absolute().parent
    for path, data in () if replace else ((folder / name, data) for name, data in beside.items()):
        if path.exists() and path.read_bytes() != data:  # the conf.json or the poses of a dataset, which lies there
            raise InvalidArgument(
                f"{path} exists and says something else: export into a folder of its own", field="output"
            )
    step, saved = scene.info.training.get("step"), io.BytesIO()
    torch.save({"step": step if type(step) is int else 0, "global_tic": 0.0, "splats": splats}, saved)
    beside[checkpoint.name] = saved.getvalue()
    folder.mkdir(exist_ok=True)
    for name, data in beside.items():  # the checkpoint last: where it lies, everything does
        write_whole(folder / name, data)
    files = tuple(checkpoint.parent / name for name in beside)
    return CheckpointExport(files, centre_mm, tuple(notes), largest_error)


def _released_view(scene: GaussianScene) -> tuple[Probe, int, int]:
    """The probe with its planes as released, and the height and width of the images that it holds for."""
    probe = scene.info.probe_or(None)
    height, width = scene.info.image_size_or(None, None)
    far_mm = probe.cull_far_mm(height)
    if not math.isfinite(far_mm):
        raise InvalidArgument("the released depth grid needs images of at least 2 rows, the scene's have 1")
    try:
        return probe.ending_at(round(far_mm, 9)), height, width
    except InvalidProbe as error:
        raise InvalidArgument(f"the scene's probe has no released depth grid: {error}") from error


def _config(probe: Probe, height: int, width: int, sh_degree: int) -> bytes:
    """conf.json as the released trainer reads it, in cm and degrees; image sizes are for our own import."""
    document = {
        **{f"{kind}_file_{part}": f"{kind}_{part}.npy" for kind in ("images", "poses") for part in ("train", "val")},
        "result_dir": "results",
        **probe_keys(probe),
        "sh_degree": sh_degree,
        "image_height": height,
        "image_width": width,
    }
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode()


def _splats(scene: GaussianScene, centre_mm: Vector, notes: list[str]) -> tuple[OrderedDict[str, Tensor], float]:
    """The six raw tensors about `centre_mm`, float32 on the CPU, each with a storage of its own."""
    shift_cm = (np.asarray(scene.info.centre_mm) - np.asarray(centre_mm)) / 10.0
    tensors = {name: tensor.detach().cpu() for name, tensor in scene.splats.items()}
    tensors["means"] = tensors["means"].double() + torch.from_numpy(shift_cm)
    largest_error = 0.0
    if scene.info.intensity == "sigmoid":
        fit = fit_released_intensity(scene.to("cpu"))
        tensors |= {"sh0": fit.sh0, "shN": fit.shN}
        largest_error = fit.largest_error
        notes.append(
            "its intensities are `sigmoid`, which the released code does not have: they are fitted to the released "
            f"activation, which knows none under 0.5, and differ by up to {largest_error:.2f}, {fit.mean_error:.2f} on "
            "average"
        )
    plain = {name: tensors[name].to(torch.float32, memory_format=torch.contiguous_format).clone() for name in SPLATS}
    return OrderedDict(plain), largest_error
