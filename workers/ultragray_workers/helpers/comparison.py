"""Work of a helper process: comparing a scene with the held-out frames of the dataset that it was trained from."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from ultragray_workers.datasets.copies import DEFAULT_MAX_BYTES
from ultragray_workers.datasets.opening import open_datasets
from ultragray_workers.helpers.helper import write_progress
from ultragray_workers.helpers.picture_stack import write_stacks

if TYPE_CHECKING:
    from ultragray.learn.evaluation.scoring import Evaluation

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

    from ultragray.confidence import Assessor
    from ultragray.learn.evaluation.baselines import affordable_voxel_mm, predict
    from ultragray.learn.evaluation.scoring import check_same_origin, evaluate_frames, render_sweep, require_frames
    from ultragray.learn.evaluation.side_by_side import DIFFERENCE_GAIN
    from ultragray.phantom import load_phantom
    from ultragray.scene import GaussianScene

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
    """Those of one frame."""
    frame = evaluation.frames[index]
    own = {name: getattr(frame, name) for name in _COMPARED}
    return {**own, "histogram_distance": evaluation.frame_speckle[index].histogram_distance}
