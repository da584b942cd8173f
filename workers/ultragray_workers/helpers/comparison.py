"""Work of a helper process: comparing a scene with the held-out frames of the dataset that it was trained from."""

from __future__ import annotations

import json
from pathlib import Path

from ..datasets.copies import DEFAULT_MAX_BYTES
from ..datasets.opening import open_datasets
from .helper import write_progress
from .picture_stack import write_stacks

FRAMES_NAME = "frames.json"
PICTURES = ("truth", "rendering", "median", "difference")
_COMPARED = ("psnr_db", "ms_ssim", "gms", "gmsd")


def compare(
    folder: str,
    artifact_folder: str,
    dataset: str,
    scene_path: str,
    storage: str | None = None,
    max_copies_bytes: int = DEFAULT_MAX_BYTES,
) -> None:
    """Fill `folder` with metrics and pictures of a scene on the frames that the dataset of this name holds out.

    It says meanwhile which share is done. Raises DatasetNotFound, DatasetInvalid where the dataset holds out none,
    SceneFileInvalid, InvalidImageSize for frames too small to measure.
    """
    import numpy as np
    import torch

    from ultragray.evaluation.baselines import predict
    from ultragray.evaluation.compounding import affordable_voxel_mm
    from ultragray.evaluation.scoring import check_same_origin, evaluate_frames, render_sweep, require_frames
    from ultragray.evaluation.side_by_side import DIFFERENCE_GAIN
    from ultragray.scene import GaussianScene

    torch.set_num_threads(1)
    filled = Path(folder)
    sweeps = open_datasets(artifact_folder, storage, max_copies_bytes).load(dataset)
    scene = GaussianScene.load(scene_path)
    check_same_origin(scene.info, sweeps)
    require_frames(sweeps.val)
    write_progress(filled, 0.1)
    median = predict(sweeps.train, sweeps.val.poses, "median", voxel_mm=affordable_voxel_mm(sweeps.train))  # [F, H, W]
    write_progress(filled, 0.4)
    rendering = render_sweep(scene, sweeps.val, backend="cpu")
    write_progress(filled, 0.7)
    measured, of_median = evaluate_frames(rendering, sweeps.val), evaluate_frames(median, sweeps.val)
    write_progress(filled, 0.9)
    truth = (sweeps.val.images / 255.0).astype(np.float32)
    difference = np.minimum(np.abs(rendering - truth) * DIFFERENCE_GAIN, 1.0)
    pictures = dict(zip(PICTURES, (truth, rendering, median, difference), strict=True))
    write_stacks(filled, pictures, sweeps.probe)
    frames = [
        {
            "index": index,
            "frame_number": int(number),
            **{name: getattr(own, name) for name in _COMPARED},
            "histogram_distance": own_speckle.histogram_distance,
            **{f"median_{name}": getattr(other, name) for name in _COMPARED},
            "median_histogram_distance": other_speckle.histogram_distance,
        }
        for index, (number, own, own_speckle, other, other_speckle) in enumerate(
            zip(
                measured.frame_numbers,
                measured.frames,
                measured.frame_speckle,
                of_median.frames,
                of_median.frame_speckle,
                strict=True,
            )
        )
    ]
    (filled / FRAMES_NAME).write_text(json.dumps(frames), encoding="utf-8")
