"""The time that a training takes after its steps, by what it takes here to render a frame and to score one."""

from __future__ import annotations

import time

import numpy as np

from ultragray.learn.evaluation.scoring import evaluate_frames
from ultragray.learn.sweep import Dataset
from ultragray.learn.training import TrainingConfig
from ultragray.learn.training.confidence import BLACK_FRAMES, LEAST_HELD_OUT, MEASURED_FRAMES, held_out_frames

STEP_RENDERINGS = 3.0  # what a view of a step costs, with its gradients, in renderings of a frame
CONFIDENCE_RENDERINGS = 4.0  # of a frame by which the confidence is fitted: image, coverage and uncertainty
PLOTS_S = 5.0  # of the report, whatever it is about
PICTURES, REPORT_FRAMES = 4, 24  # held-out frames, evenly spread
_PANELS = 3  # of a frame in the report that are rendered


class Finishing:
    """The seconds from a phase to the end of the job, beside what is trained in it."""

    def __init__(self, dataset: Dataset, config: TrainingConfig) -> None:
        self._views = min(config.batch_size, len(dataset.train))
        self._score_s = _scoring_s(dataset)
        self._frame_s = 0.0
        held_out = len(dataset.val)
        measured = len(held_out_frames(dataset.train)) if config.confidence else 0
        fitted = 0 if measured < LEAST_HELD_OUT else min(measured, MEASURED_FRAMES) + MEASURED_FRAMES // 3
        shown = PICTURES + min(held_out, REPORT_FRAMES)
        # renderings and scores of each phase
        self._work = {
            "evaluation": (float(held_out), held_out),
            "confidence": (CONFIDENCE_RENDERINGS * fitted, fitted + (BLACK_FRAMES if fitted else 0)),
            "report": (float(held_out + _PANELS * shown), held_out) if held_out else (0.0, 0),
        }
        self._plots_s = PLOTS_S if held_out else 0.0

    def observe(self, steps_per_s: float) -> None:
        """Takes the pace of the run, from which that of renderings follows."""
        if steps_per_s:
            self._frame_s = 1.0 / (steps_per_s * self._views * STEP_RENDERINGS)

    def seconds_from(self, phase: str) -> float:
        """Of this phase and all that come after it."""
        phases = list(self._work)
        work = [self._work[one] for one in phases[phases.index(phase) :]]
        return self._plots_s + sum(frames * self._frame_s + scores * self._score_s for frames, scores in work)


def _scoring_s(dataset: Dataset) -> float:
    """The seconds of scoring a frame: measured on one."""
    frame = dataset.train.select([0])
    started = time.perf_counter()
    evaluate_frames((frame.images / 255.0).astype(np.float32), frame)
    return time.perf_counter() - started
