"""Cases of the CUDA kernels are slow where they are interpreted: `make test` leaves some to `make test-long`."""

from __future__ import annotations

import pytest

from ultragray.backends import cuda

# By test: these cases take the same branches of the kernels as others that stay.
RARELY_TELL_MORE = {
    "test_matches_the_reference_in_float64": {
        "wide_fan",
        "face_beyond_apex_zero",
        "phased_at_the_face",
        "near_plane_inside",
        "large",
        "smaller_than_a_pixel",
        "needles",
        "dense_and_absorbing",
        "transparent",
        "degree_2",
        "degree_3",
        "sigmoid",
        "one_pixel",
        "one_row",
        "one_column",
        "tall",
        "broad",
        "many_poses",
    },
    "test_all_outputs_match": {"g03", "g06"},
    "test_all_outputs_together": {
        "wide fan",
        "one Gaussian",
        "shadows",
        "saturated",
        "at the face",
        "needles",
        "transparent",
        "degree 2",
        "degree 3",
    },
    "test_each_output_alone": {"linear", "shadows"},
    "test_poses_of_every_kind": {"phased", "off centre", "shadows", "needles", "degree 0", "degree 2"},
    "test_the_label_that_weighs_most_is_shown": {"linear", "phased"},
    "test_extreme_parameters_stay_exact": {"-60.0", "0.0001", "-50.0"},
    "test_golden_gradient": {"cuda"},
    "test_frames_match_the_reference_in_float64": {"linear, constant", "phased", "radial", "needles", "shadows"},
    "test_gradients_of_parameters_poses_and_beam_are_the_true_ones": {"linear, constant", "phased", "needles"},
}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if cuda.available() and not cuda.interpreted():
        return
    for item in items:
        test, _, case = item.name.removesuffix("]").partition("[")
        if "cuda" in case.split("-"):
            item.add_marker(pytest.mark.slow)
            if is_rare(case, RARELY_TELL_MORE.get(test, set())):
                item.add_marker(pytest.mark.long)


def is_rare(case: str, rare: set[str]) -> bool:
    """Whether one of the names stands in a case as a parameter of its own."""
    return any(f"-{name}-" in f"-{case}-" for name in rare)
