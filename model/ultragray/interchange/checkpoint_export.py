"""Export to the checkpoint format of the released UltraG-Ray code: the way back of `checkpoint`.

The checkpoint holds what the released trainer saves and its viewer loads: step, global_tic and the six raw tensors
(docs/physics.md §2). What it cannot say lies beside it as the released dataset layout has it: conf.json (planes and
width in cm, on the released depth grid, §3) and poses_train.npy (mm). The released code puts the origin at the mean
image corner of those poses (§6), so the Gaussians are moved there: a pose in the tracker's frame shows the same.
"""

from __future__ import annotations

import io
import json
import math
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ultragray.errors import InvalidArgument, InvalidProbe
from ultragray.files.atomic import write_whole
from ultragray.interchange.released_config import WIDTH_KEY, probe_keys, released_centre_mm
from ultragray.interchange.released_intensity import fit_released_intensity
from ultragray.probe import Probe
from ultragray.scene import GaussianScene
from ultragray.scene_info import Vector

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
            beside[POSES_NAME] = _npy(scene.training_poses)
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
    if not replace:
        _check_not_replaced(folder, beside)
    beside[checkpoint.name] = _saved({"step": _step(scene), "global_tic": 0.0, "splats": splats})
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


def _npy(array: Any) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()


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


def _step(scene: GaussianScene) -> int:
    step = scene.info.training.get("step")
    return step if type(step) is int else 0


def _saved(document: Mapping[str, Any]) -> bytes:
    buffer = io.BytesIO()
    torch.save(dict(document), buffer)
    return buffer.getvalue()


def _check_not_replaced(folder: Path, files: Mapping[str, bytes]) -> None:
    """An export into the folder of a dataset would replace the dataset's own conf.json and poses."""
    for name, data in files.items():
        path = folder / name
        if path.exists() and path.read_bytes() != data:
            raise InvalidArgument(
                f"{path} exists and says something else: export into a folder of its own", field="output"
            )
