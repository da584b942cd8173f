"""The helper process that renders a running training as its last checkpoint has it, beside the frame it should be."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..datasets.store import DatasetStore
from .helper import answer_request
from .picture_stack import write_stacks

PICTURES = ("truth", "rendering")


def main() -> None:
    """Answers the request on stdin."""
    answer_request(draw_preview)


def draw_preview(request: dict[str, Any]) -> None:
    """Writes truth and rendering of one frame of the dataset `dataset` in `artifact_folder` into `folder`.

    The frame is the middle one of those held out, else of those trained from; the scene that of `checkpoint`. Raises
    DatasetNotFound, DatasetInvalid, TrainingStateInvalid.
    """
    import numpy as np
    import torch

    from ultragray.datasets.source import SourceOptions, load_dataset
    from ultragray.evaluation.scoring import render_sweep
    from ultragray.scene import PARAMETERS, GaussianScene
    from ultragray.scene_info import SceneInfo
    from ultragray.training.checkpointing import read_checkpoint

    torch.set_num_threads(1)
    header, tensors = read_checkpoint(Path(request["checkpoint"]))
    source, options = DatasetStore(Path(request["artifact_folder"])).source(request["dataset"])
    dataset = load_dataset(source, SourceOptions(**options))
    x, y, z = dataset.centre_mm.tolist()
    scene = GaussianScene.from_splats(
        {name: tensors[f"parameter.{name}"] for name in PARAMETERS},
        info=SceneInfo(centre_mm=(x, y, z), probe=dataset.probe, intensity=header.config.intensity),
    )
    part = dataset.val if len(dataset.val) else dataset.train
    frame = part.select(np.array([len(part) // 2]))
    truth = (frame.images / 255.0).astype(np.float32)
    pictures = dict(zip(PICTURES, (truth, render_sweep(scene, frame, backend="cpu")), strict=True))
    write_stacks(Path(request["folder"]), pictures, dataset.probe)
