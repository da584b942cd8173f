"""What classical methods reach on the frames that a training is validated on: the lines on its curve."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from ultragray.files import write_whole
from ultragray.learn.evaluation.baselines import affordable_voxel_mm, evaluate_baselines
from ultragray.learn.sweep import Dataset, spread_places
from ultragray.learn.training.trainer import VALIDATION_FRAMES

METHODS = ("linear", "median")
MAX_PIXELS = 1 << 26  # of the sweep: about ten seconds; a larger one begins at once, without the lines


def write_baselines(dataset: Dataset, path: Path, should_stop: Callable[[], bool]) -> None:
    """Writes the PSNR in dB of each method, by name, as JSON.

    Nothing where there is a file already, no frame is held out, the sweep is too large, or it is to stop.
    """
    if path.exists() or not len(dataset.val) or dataset.train.images.size > MAX_PIXELS:
        return
    few = replace(dataset, val=dataset.val.select(spread_places(len(dataset.val), VALIDATION_FRAMES)))
    voxel_mm, found = affordable_voxel_mm(dataset.train), {}
    for method in METHODS:
        if should_stop():
            return
        found[method] = evaluate_baselines(few, (method,), voxel_mm)[method].mean.psnr_db
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, json.dumps(found) + "\n")
