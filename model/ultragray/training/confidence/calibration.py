"""The model of `confidence`, fitted on frames that a shorter training of its own did not see."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from ultragray.confidence.assess import supported
from ultragray.confidence.model import ConfidenceModel, predicted, terms_of
from ultragray.confidence.views import TrainingViews
from ultragray.datasets.sweep import Dataset, Sweep, spread_places
from ultragray.evaluation.scoring import evaluate, evaluate_frames, render_sweep
from ultragray.probe import FloatArray
from ultragray.scene import GaussianScene
from ultragray.training.confidence.fitting import Examples, fit_support, fit_weights
from ultragray.training.confidence.hardness import hardness_of_views
from ultragray.training.confidence.held_out import LEAST_HELD_OUT, held_out_frames
from ultragray.training.confidence.one_sided import one_sided_examples
from ultragray.training.confidence.residuals import fit_uncertainty
from ultragray.training.config import TrainingConfig

SHORTER, ENOUGH_STEPS = 0.25, 150  # share of the steps, and the number that is not cut: longer tells the same
MEASURED_FRAMES = 96  # of those held out; of those trained from a third as many
BLACK_FRAMES = 32

TrainShorter: TypeAlias = Callable[[Dataset], GaussianScene | None]


def shorter(config: TrainingConfig, share: float) -> TrainingConfig:
    """The configuration of a training on `share` of the frames, with nothing left open: a quarter of the steps, or
    ENOUGH_STEPS."""
    assert config.steps is not None
    assert config.max_gaussians is not None
    assert config.initial_gaussians is not None
    return replace(
        config,
        steps=min(config.steps, max(math.ceil(SHORTER * config.steps), ENOUGH_STEPS)),
        max_gaussians=math.ceil(share * config.max_gaussians),
        initial_gaussians=math.ceil(share * config.initial_gaussians),
    )


def steps_of_fit(config: TrainingConfig, sweep: Sweep) -> float:
    """The steps of a run on all frames of the sweep that take about as long as the shorter training; 0 without one."""
    held_out = len(held_out_frames(sweep))
    if held_out < LEAST_HELD_OUT:
        return 0.0
    share = 1.0 - held_out / len(sweep)
    steps = shorter(config, share).steps
    assert steps is not None
    return share * steps


def fit_confidence(dataset: Dataset, train_shorter: TrainShorter, *, backend: str) -> ConfidenceModel | None:
    """Holds frames of `dataset.train` out, trains from the others and fits the model to the scores of those held out.

    How fast scores fall farther away is told by frames that are extrapolated from others without learning, too.

    None where there are too few frames, or where `train_shorter` returns none.
    """
    sweep = dataset.train
    held_out = held_out_frames(sweep)
    if len(held_out) < LEAST_HELD_OUT:
        return None
    kept = np.setdiff1d(np.arange(len(sweep)), held_out)
    part = Dataset(dataset.name, train=sweep.select(kept), val=sweep.select([]))
    scene = train_shorter(part)
    if scene is None:
        return None
    seen = kept[spread_places(len(kept), MEASURED_FRAMES // 3)]
    unseen = held_out[spread_places(len(held_out), MEASURED_FRAMES)]
    both = sweep.select(np.concatenate([unseen, seen]))
    ms_ssim, shares = _measured(scene, both, backend)
    views = TrainingViews(part.train.poses, sweep.probe)
    measures = views.measure(both.poses, sweep.probe)
    terms = terms_of(measures, hardness_of_views(part.train))
    black, hardness = _black_ms_ssim(sweep), hardness_of_views(sweep)
    weights = fit_weights(Examples(terms, ms_ssim), black, one_sided_examples(sweep, hardness))
    misses = np.abs(predicted(weights, terms, black) - ms_ssim)[: len(unseen)]
    return ConfidenceModel(
        weights=tuple(weights.tolist()),
        black_ms_ssim=black,
        hardness=tuple(hardness.tolist()),
        fitted_on=len(unseen),
        error=float(misses.mean()),
        support=fit_support(measures, shares, ms_ssim, black),
        fitted_to_mm=float(measures.distance_mm.max()),
        uncertainty=fit_uncertainty(scene, views, both, backend=backend),
    )


def _measured(scene: GaussianScene, sweep: Sweep, backend: str) -> tuple[FloatArray, FloatArray]:  # [F], [F]
    """MS-SSIM and the share of supported pixels of each frame."""
    ms_ssim = [frame.ms_ssim for frame in evaluate(scene, sweep, backend=backend).frames]
    coverage = render_sweep(scene, sweep, output="coverage", backend=backend)
    return np.array(ms_ssim), supported(coverage).mean(axis=(1, 2))


def _black_ms_ssim(sweep: Sweep) -> float:
    """The mean score of a black frame against the training frames."""
    some = sweep.select(spread_places(len(sweep), BLACK_FRAMES))
    return evaluate_frames(np.zeros(some.images.shape, np.float32), some).mean.ms_ssim
