"""The helper process that compares a scene with the held-out frames of the dataset that it was trained from."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..datasets.store import DatasetStore
from .helper import answer_request, tell_progress
from .picture_stack import write_stacks

FRAMES_NAME = "frames.json"
PICTURES = ("truth", "rendering", "median", "difference")
_COMPARED = ("psnr_db", "ms_ssim", "gms", "gmsd")


def main() -> None:
    """Answers the request on stdin."""
    answer_request(compare)


def compare(request: dict[str, Any]) -> None:
    """Fills `folder` with the metrics and pictures of the scene at `scene_path` on the frames that the dataset
    `dataset` in `artifact_folder` holds out.

    It tells meanwhile which share is done. Raises DatasetNotFound, DatasetInvalid where it holds out none,
    SceneFileInvalid, InvalidImageSize for frames too small to measure.
    """
    import numpy as np
    import torch

    from ultragray.datasets.source import SourceOptions, load_dataset
    from ultragray.evaluation.baselines import predict
    from ultragray.evaluation.compounding import affordable_voxel_mm
    from ultragray.evaluation.scoring import check_same_origin, evaluate_frames, render_sweep, require_frames
    from ultragray.evaluation.side_by_side import DIFFERENCE_GAIN
    from ultragray.scene import GaussianScene

    torch.set_num_threads(1)
    folder = Path(request["folder"])
    source, options = DatasetStore(Path(request["artifact_folder"])).source(request["dataset"])
    dataset = load_dataset(source, SourceOptions(**options))
    scene = GaussianScene.load(request["scene_path"])
    check_same_origin(scene.info, dataset)
    require_frames(dataset.val)
    tell_progress(folder, 0.1)
    median = predict(
        dataset.train, dataset.val.poses, "median", voxel_mm=affordable_voxel_mm(dataset.train)
    )  # [F, H, W]
    tell_progress(folder, 0.4)
    rendering = render_sweep(scene, dataset.val, backend="cpu")
    tell_progress(folder, 0.7)
    measured, of_median = evaluate_frames(rendering, dataset.val), evaluate_frames(median, dataset.val)
    tell_progress(folder, 0.9)
    truth = (dataset.val.images / 255.0).astype(np.float32)
    difference = np.minimum(np.abs(rendering - truth) * DIFFERENCE_GAIN, 1.0)
    pictures = dict(zip(PICTURES, (truth, rendering, median, difference), strict=True))
    write_stacks(folder, pictures, dataset.probe)
    told = [
        {
            "index": index,
            "frame_number": int(number),
            **{name: getattr(own, name) for name in _COMPARED},
            **{f"median_{name}": getattr(other, name) for name in _COMPARED},
        }
        for index, (number, own, other) in enumerate(
            zip(measured.frame_numbers, measured.frames, of_median.frames, strict=True)
        )
    ]
    (folder / FRAMES_NAME).write_text(json.dumps(told), encoding="utf-8")
