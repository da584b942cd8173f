"""Work of helper processes, each filling a folder to look at: a dataset's frames, a training's last checkpoint, a
scene beside held-out frames.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from ultragray_workers.datasets.store import open_datasets
from ultragray_workers.helpers import write_progress, write_stacks
from ultragray_workers.storage.cache import DEFAULT_MAX_BYTES

if TYPE_CHECKING:
    from ultragray.learn.evaluation.scoring import Evaluation


POSES_NAME = "poses.json"
PARTS = ("train", "val")


def lay_out(
    folder: str,
    artifact_folder: str,
    dataset: str,
    storage: str | None = None,
    max_copies_bytes: int = DEFAULT_MAX_BYTES,
) -> None:
    """Fill `folder` with the poses and frames of the dataset of this name. Raises DatasetNotFound, DatasetInvalid."""
    sweeps = open_datasets(artifact_folder, storage, max_copies_bytes).load(dataset)
    parts = dict(zip(PARTS, (sweeps.train, sweeps.val), strict=True))
    write_stacks(Path(folder), {part: sweep.images for part, sweep in parts.items()}, sweeps.probe)
    poses = {part: sweep.poses.reshape(-1, 16).tolist() for part, sweep in parts.items()}
    (Path(folder) / POSES_NAME).write_text(json.dumps(poses), encoding="utf-8")


# Work of a helper process: rendering a running training as its last checkpoint has it, beside the true frame.


PREVIEW_PICTURES = ("truth", "rendering")


def draw_preview(
    folder: str,
    artifact_folder: str,
    dataset: str,
    checkpoint: str,
    storage: str | None = None,
    max_copies_bytes: int = DEFAULT_MAX_BYTES,
) -> None:
    """Write truth and rendering of one frame of the dataset of this name into `folder`.

    The frame is the middle one of those held out, else of those trained from; the scene is that of `checkpoint`.
    Raises DatasetNotFound, DatasetInvalid, TrainingStateInvalid.
    """
    import numpy as np
    import torch

    from ultragray.learn.evaluation.scoring import render_sweep
    from ultragray.learn.training.checkpointing import read_checkpoint
    from ultragray.scene.gaussians import PARAMETERS, GaussianScene
    from ultragray.scene.info import SceneInfo

    torch.set_num_threads(1)
    header, tensors = read_checkpoint(Path(checkpoint))
    sweeps = open_datasets(artifact_folder, storage, max_copies_bytes).load(dataset)
    scene = GaussianScene.from_splats(
        {name: tensors[f"parameter.{name}"] for name in PARAMETERS},
        info=SceneInfo(centre_mm=sweeps.centre_mm.tolist(), probe=sweeps.probe, intensity=header.config.intensity),
    )
    part = sweeps.val if len(sweeps.val) else sweeps.train
    frame = part.select(np.array([len(part) // 2]))
    truth = (frame.images / 255.0).astype(np.float32)
    pictures = dict(zip(PREVIEW_PICTURES, (truth, render_sweep(scene, frame, backend="cpu")), strict=True))
    write_stacks(Path(folder), pictures, sweeps.probe)


# Work of a helper process: comparing a scene with the held-out frames of the dataset that it was trained from.


FRAMES_NAME = "frames.json"
CLASSICAL = ("median", "linear", "nearest")  # of ultragray.learn.evaluation.baselines.BASELINES
PICTURES = ("truth", "rendering", *CLASSICAL, "difference")
_COMPARED = ("psnr_db", "ms_ssim", "gms", "gmsd")


def compare(
    folder: str,
    artifact_folder: str,
    dataset: str | None,
    scene_path: str,
    storage: str | None = None,
    max_copies_bytes: int = DEFAULT_MAX_BYTES,
) -> None:
    """Fill `folder` with metrics and pictures of a scene on the frames that the dataset of this name holds out.

    None is the built-in phantom, which is simulated. It says meanwhile which share is done. Raises DatasetNotFound,
    DatasetInvalid where the dataset holds out none, SceneFileInvalid, InvalidImageSize for frames too small to measure.
    """
    import numpy as np
    import torch

    from ultragray.learn.evaluation.baselines import affordable_voxel_mm, predict
    from ultragray.learn.evaluation.scoring import check_same_origin, evaluate_frames, render_sweep, require_frames
    from ultragray.learn.evaluation.side_by_side import DIFFERENCE_GAIN
    from ultragray.phantom import load_phantom
    from ultragray.scene.confidence import Assessor
    from ultragray.scene.gaussians import GaussianScene

    torch.set_num_threads(1)
    filled = Path(folder)
    scene = GaussianScene.load(scene_path)
    if dataset is None:
        sweeps = load_phantom()
    else:
        sweeps = open_datasets(artifact_folder, storage, max_copies_bytes).load(dataset)
        check_same_origin(scene.info, sweeps)
    held_out = sweeps.val
    require_frames(held_out)
    write_progress(filled, 0.1)
    voxel_mm = affordable_voxel_mm(sweeps.train)
    predicted = {}  # [F, H, W] by name
    for done, name in enumerate(CLASSICAL, 1):
        predicted[name] = predict(sweeps.train, held_out.poses, name, voxel_mm=voxel_mm)
        write_progress(filled, 0.1 + 0.1 * done)
    predicted["rendering"] = render_sweep(scene, held_out, backend="cpu")
    write_progress(filled, 0.7)
    measured = {name: evaluate_frames(frames, held_out) for name, frames in predicted.items()}
    coverage = render_sweep(scene, held_out, backend="cpu", output="coverage")
    trusted = Assessor(scene.info, scene.training_poses).assess(held_out.poses, held_out.probe, coverage=coverage)
    write_progress(filled, 0.9)
    truth = (held_out.images / 255.0).astype(np.float32)
    difference = np.minimum(np.abs(predicted["rendering"] - truth) * DIFFERENCE_GAIN, 1.0)
    pictures = {"truth": truth, **predicted, "difference": difference}
    write_stacks(filled, {name: pictures[name] for name in PICTURES}, sweeps.probe)
    frames = [
        {
            "index": index,
            "frame_number": int(number),
            "pose": held_out.poses[index].tolist(),
            "confidence": trusted[index].confidence,
            **{
                f"{'' if name == 'rendering' else f'{name}_'}{metric}": value
                for name, evaluation in measured.items()
                for metric, value in _metrics(evaluation, index).items()
            },
        }
        for index, number in enumerate(held_out.frame_numbers)
    ]
    (filled / FRAMES_NAME).write_text(json.dumps(frames), encoding="utf-8")


def _metrics(evaluation: Evaluation, index: int) -> dict[str, float]:
    frame = evaluation.frames[index]
    own = {name: getattr(frame, name) for name in _COMPARED}
    return {**own, "histogram_distance": evaluation.frame_speckle[index].histogram_distance}
