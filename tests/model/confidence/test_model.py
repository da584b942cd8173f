"""The model: what it says falls with distance, and damaged numbers never become one."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ultragray.errors import InvalidArgument
from ultragray.scene.confidence import ConfidenceModel, Support, ViewMeasures

MODEL = ConfidenceModel(
    weights=(3.5, 1.2, 0.8, 0.1, 0.6),
    black_ms_ssim=0.06,
    hardness=(0.0, 1.0),
    fitted_on=20,
    error=0.04,
    support=Support(1.5, 0.9, 4.0),
    fitted_to_mm=2.0,
)


def measures(
    distance_mm: float = 0.0, interpolation_mm: float = 0.0, angle_deg: float = 0.0, weight: float = 0.0
) -> ViewMeasures:
    """`weight`: of the harder of two views."""
    values = (np.array([[value]]) for value in (distance_mm, distance_mm, interpolation_mm, angle_deg))
    return ViewMeasures(*values, weights=np.array([[1.0 - weight, weight]]))


def test_the_formula() -> None:
    at_a_view = 0.06 + 0.94 / (1.0 + np.exp(-3.5))
    assert MODEL.predict(measures()) == pytest.approx([at_a_view])
    away = 3.5 - 1.2 * np.log(1.0 + 0.9 / 0.3) - 0.8 * 2.0 / 5.0 - 0.1 * 5.0 / 10.0 - 0.6 * 0.25
    expected = 0.06 + 0.94 / (1.0 + np.exp(-away))
    assert MODEL.predict(measures(2.0, 0.9, 5.0, 0.25)) == pytest.approx([expected])


def test_each_point_has_its_own_curve() -> None:
    half_known = ViewMeasures(
        *(np.array([[0.0, far]]) for far in (20.0, 20.0, 20.0, 0.0)), weights=np.array([[1.0, 0.0]])
    )
    model = replace(MODEL, support=None)
    known, unknown = model.predict(measures())[0], model.predict(measures(20.0, 20.0))[0]
    assert model.predict(half_known) == pytest.approx([0.5 * (known + unknown)])


def test_distance_beyond_what_it_was_fitted_on_counts_twice() -> None:
    ending = replace(MODEL, support=None)
    endless = replace(ending, fitted_to_mm=None)
    assert ending.predict(measures(3.0)) == pytest.approx(endless.predict(measures(4.0)))
    assert ending.predict(measures(2.0)) == pytest.approx(endless.predict(measures(2.0)))


def test_little_support_limits_the_confidence() -> None:
    told = MODEL.limited(np.array([0.8, 0.2, 0.99]), np.array([0.2, 0.2, 0.7]))
    assert told == pytest.approx([0.06 + 0.94 * 1.5 * 0.2, 0.2, 0.99])
    assert replace(MODEL, support=None).limited(np.array([0.8]), np.array([0.0])) == [0.8]


def test_a_pose_alone_is_taken_to_have_the_support_of_its_distance() -> None:
    least = replace(MODEL, weights=(9.0, 0.0, 0.0, 0.0, 0.0))  # that would be sure of everything
    assert least.predict(measures(0.0)) == pytest.approx([0.06 + 0.94 / (1.0 + np.exp(-9.0))])
    assert least.predict(measures(6.0)) == pytest.approx([0.06 + 0.94 * 1.5 * 0.9 * np.exp(-((6.0 / 4.0) ** 2))])


@pytest.mark.parametrize("name", ["distance_mm", "interpolation_mm", "angle_deg", "weight"])
def test_farther_is_never_surer(name: str) -> None:
    figures = [MODEL.predict(measures(**{name: value}))[0] for value in (0.0, 0.1, 0.5, 1.0)]
    assert figures == sorted(figures, reverse=True)
    assert figures[0] > figures[-1]


def test_far_away_it_is_what_a_black_frame_reaches() -> None:
    far = ConfidenceModel((3.5, 1.2, 8.0, 0.1, 0.6), 0.06, (0.0, 1.0), 20, 0.04)
    assert far.predict(measures(20.0, 20.0)) == pytest.approx([0.06], abs=1e-4)


def test_json_and_back() -> None:
    for model in (MODEL, replace(MODEL, support=None, fitted_to_mm=None)):
        document = json.loads(json.dumps(model.to_dict(), allow_nan=False))
        assert document["version"] == 2
        assert ConfidenceModel.from_dict(document) == model


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"version": 3}, "version 2, got 3"),
        ({"support": {"gain": 0.0, "share": 0.5, "reach_mm": 1.0}}, "support must be positive"),
        ({"support": {"gain": "much", "share": 0.5, "reach_mm": 1.0}}, "support must be numbers"),
        ({"support": 1.5}, "support must be an object"),
        ({"fitted_to_mm": -1.0}, "fitted_to_mm must be 1 numbers, at least 0"),
        ({"weights": [1.0, 2.0]}, "weights must be 5 numbers"),
        ({"weights": [1.0, -2.0, 0, 0, 0]}, "at least 0"),
        ({"weights": ["a"] * 5}, "weights must be numbers"),
        ({"weights": [float("nan")] * 5}, "weights must be finite"),
        ({"hardness": [float("inf")]}, "hardness must be finite"),
        ({"hardness": None}, "hardness must be numbers"),
        ({"black_ms_ssim": 1.5}, r"in \[0, 1\], got 1.5"),
        ({"error": "much"}, "must be numbers"),
        ({"fitted_on": 0}, "fitted_on must be an integer of at least 1"),
        ({"more": 1}, "with the keys"),
    ],
)
def test_damage_is_refused(change: dict[str, Any], said: str) -> None:
    with pytest.raises(InvalidArgument, match=said):
        ConfidenceModel.from_dict({**MODEL.to_dict(), **change})


def test_what_is_no_object_is_refused() -> None:
    with pytest.raises(InvalidArgument, match="must be an object"):
        ConfidenceModel.from_dict([1, 2])  # type: ignore[arg-type]
