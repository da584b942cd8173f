"""The study of prediction: the best linear predictor in hindsight, on paths of which is known what it leaves."""

import numpy as np
import pytest

from ..scripts import benchmark


def along_x(places_mm):  # [N] -> [N, 4, 4]
    poses = np.tile(np.eye(4), (len(places_mm), 1, 1))
    poses[:, 0, 3] = places_mm
    return poses


def test_the_best_linear_predictor_foretells_a_steady_path_and_not_one_of_chance():
    at_best = benchmark("prediction").at_best
    times_s = np.arange(400) / 20.0
    steps_mm = np.random.default_rng(0).normal(size=400)
    wandered_mm = np.cumsum(steps_mm)
    for places_mm, most_mm in ((3.0 * times_s, 0.2), (wandered_mm, 1.1)):
        seen_s = times_s + 0.05

        def truth(at_s, places_mm=places_mm):
            return along_x(np.interp(at_s, times_s, places_mm))

        left_mm, left_deg = at_best(times_s, along_x(places_mm), seen_s, truth)
        assert left_mm < most_mm
        assert left_deg == pytest.approx(0.0, abs=1e-9)
    assert left_mm > 0.85
