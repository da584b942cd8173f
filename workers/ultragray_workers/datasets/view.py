"""The helper process that lays a dataset out for looking at: its poses, and its frames one by one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..helpers.helper import answer_request
from ..helpers.picture_stack import write_stacks
from .store import DatasetStore

POSES_NAME = "poses.json"
PARTS = ("train", "val")


def main() -> None:
    """Answers the request on stdin."""
    answer_request(lay_out)


def lay_out(request: dict[str, Any]) -> None:
    """Fills `folder` with the poses and frames of the dataset `dataset` in `artifact_folder`.

    Raises DatasetNotFound, DatasetInvalid.
    """
    from ultragray.datasets.source import SourceOptions, load_dataset

    folder = Path(request["folder"])
    source, options = DatasetStore(Path(request["artifact_folder"])).source(request["dataset"])
    dataset = load_dataset(source, SourceOptions(**options))
    parts = dict(zip(PARTS, (dataset.train, dataset.val), strict=True))
    write_stacks(folder, {part: sweep.images for part, sweep in parts.items()}, dataset.probe)
    poses = {part: sweep.poses.reshape(-1, 16).tolist() for part, sweep in parts.items()}
    (folder / POSES_NAME).write_text(json.dumps(poses), encoding="utf-8")
