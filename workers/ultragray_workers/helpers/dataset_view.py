"""Work of a helper process: laying a dataset out for looking at, its poses and its frames one by one."""

from __future__ import annotations

import json
from pathlib import Path

from ultragray_workers.datasets.copies import DEFAULT_MAX_BYTES
from ultragray_workers.datasets.opening import open_datasets
from ultragray_workers.helpers.picture_stack import write_stacks

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
