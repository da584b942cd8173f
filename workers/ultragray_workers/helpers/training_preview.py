"""Work of a helper process: rendering a running training as its last checkpoint has it, beside the true frame."""

from __future__ import annotations

from pathlib import Path

from ultragray_workers.datasets.copies import DEFAULT_MAX_BYTES
from ultragray_workers.datasets.opening import open_datasets
from ultragray_workers.helpers.picture_stack import write_stacks

PICTURES = ("truth", "rendering")


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
    from ultragray.scene import PARAMETERS, GaussianScene
    from ultragray.scene_info import SceneInfo

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
    pictures = dict(zip(PICTURES, (truth, render_sweep(scene, frame, backend="cpu")), strict=True))
    write_stacks(Path(folder), pictures, sweeps.probe)
