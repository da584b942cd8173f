"""The fit: frames decide the weights, the rest stays at the prior, and interpolated frames tell the slope alone."""

import numpy as np
import pytest

from ultragray.learn.training.confidence import GAIN_QUANTILE, PRIOR_WEIGHTS, Examples, fit_support, fit_weights
from ultragray.scene.confidence import ViewMeasures, predicted


def test_support_is_fitted_so_that_most_frames_keep_to_it():
    distances = np.linspace(0.0, 6.0, 100)
    away = ViewMeasures(*(distances[:, None],) * 3, np.zeros((100, 1)), np.ones((100, 1)))
    shares = 0.8 * np.exp(-np.square(distances / 3.0))
    gains = np.random.default_rng(0).permutation(np.linspace(1.0, 2.0, 100))
    found = fit_support(away, shares, 0.1 + 0.9 * gains * np.maximum(shares, 0.02), 0.1)
    assert found.gain == pytest.approx(1.0 + GAIN_QUANTILE, abs=0.02)
    assert (found.share, found.reach_mm) == pytest.approx((0.8, 3.0), rel=0.05)
    assert fit_support(away, np.ones(100), np.full(100, 0.6), 0.1).gain == 1.0


def test_views_decide_the_weights():
    rng = np.random.default_rng(0)
    terms = np.concatenate([np.ones((400, 5, 1)), -rng.uniform(0.0, 2.0, (400, 5, 4))], axis=2)
    truth = np.array([2.5, 0.4, 2.0, 0.8, 0.0])
    fitted = fit_weights(Examples(terms, predicted(truth, terms, 0.1)), 0.1)
    assert np.abs(predicted(fitted, terms, 0.1) - predicted(truth, terms, 0.1)).mean() < 0.02
    assert fitted[2] > 1.5 > 0.8 > fitted[1]


def test_no_weight_turns_negative_though_the_views_say_so():
    distances = np.linspace(0.0, 2.0, 500)
    terms = np.column_stack([np.ones(500), -distances, *np.zeros((3, 500))])[:, None]
    fitted = fit_weights(Examples(terms, 0.3 + 0.3 * distances), 0.05)
    assert fitted[1] == 0.0
    assert predicted(fitted, terms, 0.05).std() < 1e-12


def test_what_the_views_cannot_tell_stays_as_it_was():
    terms = np.column_stack([np.ones(30), -np.linspace(0, 2, 30), *np.zeros((3, 30))])[:, None]
    fitted = fit_weights(Examples(terms, predicted(np.array([3.0, 2.0, 0, 0, 0]), terms, 0.05)), 0.05)
    assert fitted[2:] == pytest.approx(PRIOR_WEIGHTS[2:])
    assert fitted[1] > PRIOR_WEIGHTS[1]


def along_a_line(distances, weights):
    """Frames with only a constant and one term, that reach what these two weights tell."""
    terms = np.column_stack([np.ones_like(distances), -distances, *np.zeros((3, len(distances)))])[:, None]
    return Examples(terms, predicted(np.array([*weights, 0.0, 0.0, 0.0]), terms, 0.05))


def test_interpolated_frames_tell_how_scores_fall_and_not_how_high_they_are():
    rendered = along_a_line(np.zeros(60), (2.0, 0.0))  # all at one place: they leave the slope open
    worse_and_falling = along_a_line(np.linspace(0.0, 2.0, 300), (1.0, 3.0))
    without, fitted = fit_weights(rendered, 0.05), fit_weights(rendered, 0.05, worse_and_falling)
    assert without[1] == pytest.approx(PRIOR_WEIGHTS[1])
    assert 0.5 * (PRIOR_WEIGHTS[1] + 3.0) < fitted[1] < 3.1  # more than half of the way from the prior
    assert fitted[0] == pytest.approx(2.0, abs=0.3)
