"""Banded factors of second differences against the same in dense matrices."""

import numpy as np
import pytest

from ultragray.learn.training.alignment import likelihood_terms, smoothed

RATIOS = np.array([1e-6, 1e-2, 1.0, 1e6])


def differences(count):  # [F − 2, F]
    return np.diff(np.eye(count), 2, axis=0)


@pytest.mark.parametrize("count", [5, 40])
def test_likelihoods_are_those_of_dense_matrices(count):
    d, bends = differences(count), np.random.default_rng(0).normal(size=(count - 2, 6))
    log_determinants, squares = likelihood_terms(bends, RATIOS)
    for place, ratio in enumerate(RATIOS):
        covariance = ratio * np.eye(count - 2) + d @ d.T
        np.testing.assert_allclose(log_determinants[place], np.linalg.slogdet(covariance)[1], rtol=1e-8, atol=1e-8)
        expected = (bends * np.linalg.solve(covariance, bends)).sum(axis=0)
        np.testing.assert_allclose(squares[place], expected, rtol=1e-6)


@pytest.mark.parametrize("ratio", RATIOS)
@pytest.mark.parametrize("count", [5, 40])
def test_the_smooth_path_is_that_of_a_dense_matrix(count, ratio):
    d, values = differences(count), np.random.default_rng(1).normal(size=count).cumsum()
    expected = np.linalg.solve(np.eye(count) + d.T @ d / ratio, values)
    np.testing.assert_allclose(smoothed(values, ratio), expected, rtol=1e-6, atol=1e-6)
