"""Cases of the CUDA kernels are slow where they are interpreted: `make test` leaves most to `make test-long`."""

import pytest

from ultragray.rendering.backends import cuda

# The cases of tests that stay; of tests that are not here none does. They take most branches of the kernels.
IN_EVERY_RUN = {
    "test_matches_the_reference_in_float64": {"convex", "steered", "sigmoid_degree_3"},
    "test_all_outputs_match": {"g01"},
    "test_all_outputs_together": {"convex"},
    "test_poses_of_every_kind": {"convex"},
    "test_sums_and_gradients_are_those_of_the_reference_in_float64": {"linear"},
    "test_the_label_that_weighs_most_is_shown": {"convex"},
    "test_extreme_parameters_stay_exact": {"60.0"},
    "test_extreme_gaussians": {"cuda"},
    "test_the_depth_cull_is_by_the_mean": {"cuda"},
    "test_frames_match_the_reference_in_float64": {"convex"},
    "test_gradients_of_parameters_poses_and_beam_are_the_true_ones": {"convex"},
}


def pytest_collection_modifyitems(items):
    if cuda.available() and not cuda.interpreted():
        return
    for item in items:
        test, _, case = item.name.removesuffix("]").partition("[")
        if "cuda" in case.split("-"):
            item.add_marker(pytest.mark.slow)
            if not is_one_of(case, IN_EVERY_RUN.get(test, set())):
                item.add_marker(pytest.mark.long)


def is_one_of(case, names):
    """Whether one of the names stands in a case as a parameter of its own."""
    return any(f"-{name}-" in f"-{case}-" for name in names)
