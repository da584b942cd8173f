"""The effort of a training, chosen on frames that are left out: more of it fits the frames better, not their gaps."""

from __future__ import annotations

import contextlib
import json
import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from ultragray.datasets.sweep import Dataset
from ultragray.errors import MemoryExceeded, TrainingDiverged
from ultragray.evaluation.metrics import FrameMetrics
from ultragray.files.atomic import write_whole
from ultragray.training.confidence.held_out import LEAST_HELD_OUT, held_out_frames
from ultragray.training.config import USUAL_EFFORT, TrainingConfig

EFFORTS_FILE = "efforts.json"
OTHER_EFFORTS = ((2.0, 3.0), (0.5, 0.25))  # upwards, then downwards, as long as each is better than the one before

log = logging.getLogger(__name__)

TryOut: TypeAlias = Callable[[Dataset, TrainingConfig], FrameMetrics | None]


def choose_effort(dataset: Dataset, config: TrainingConfig, try_out: TryOut, folder: Path | None) -> float | None:
    """The effort that shows a part of the training frames best after a training on the others; 1 for too few frames.

    `try_out` trains and returns the mean metrics of the frames left out. Another effort than 1 must be better in each
    of them. None where `try_out` returns none: it was told to stop. `folder` keeps what was found: a choice that begins
    anew there has to try the rest only.
    """
    held_out = held_out_frames(dataset.train)
    if len(held_out) < LEAST_HELD_OUT:
        return USUAL_EFFORT
    kept = np.setdiff1d(np.arange(len(dataset.train)), held_out)
    part = Dataset(dataset.name, train=dataset.train.select(kept), val=dataset.train.select(held_out))
    tried = _Tried(dataset, config, folder)

    def measured(effort: float) -> FrameMetrics | None:
        found = tried.metrics.get(effort) or try_out(part, replace(config, effort=effort, confidence=False))
        if found is not None:
            tried.add(effort, found)
        return found

    chosen, best = USUAL_EFFORT, measured(USUAL_EFFORT)
    if best is None:
        return None
    for direction in OTHER_EFFORTS:
        for effort in direction if chosen == USUAL_EFFORT else ():
            try:
                found = measured(effort)
            except (MemoryExceeded, TrainingDiverged) as error:
                log.warning("effort %g cannot be tried: %s", effort, error)
                break
            if found is None:
                return None
            if not found.is_better_than(best):
                break
            chosen, best = effort, found
    log.info("effort %g shows the frames left out best: %.2f dB", chosen, best.psnr_db)
    return chosen


class _Tried:
    """What was found by effort; also in a file, where the run has a folder."""

    def __init__(self, dataset: Dataset, config: TrainingConfig, folder: Path | None) -> None:
        self.metrics: dict[float, FrameMetrics] = {}
        self._path = None if folder is None else folder / EFFORTS_FILE
        self._run = {"dataset_sha256": dataset.sha256, "config": config.to_dict()}
        if self._path is not None:
            with contextlib.suppress(OSError, ValueError, LookupError, TypeError):  # then it is tried again
                document = json.loads(self._path.read_text(encoding="utf-8"))
                if {name: document[name] for name in self._run} == self._run:
                    self.metrics = {float(effort): FrameMetrics(**of) for effort, of in document["metrics"].items()}

    def add(self, effort: float, metrics: FrameMetrics) -> None:
        self.metrics[effort] = metrics
        if self._path is None:
            return
        self._path.parent.mkdir(parents=True, exist_ok=True)
        found = {str(effort): metrics.to_dict() for effort, metrics in self.metrics.items()}
        write_whole(self._path, json.dumps({**self._run, "metrics": found}, indent=2) + "\n")
