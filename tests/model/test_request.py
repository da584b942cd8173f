"""Outputs and image sizes, as asked for."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ultragray import SceneInfo
from ultragray.errors import InvalidImageSize, UnknownOutput
from ultragray.request import ALL_OUTPUTS, MAX_IMAGE_SIDE, check_image_size, check_labelled, check_outputs


def test_outputs_keep_their_order_without_repetitions() -> None:
    assert check_outputs(["coverage", "bmode", "coverage"]) == ("coverage", "bmode")
    assert check_outputs("echo") == ("echo",)
    assert check_outputs(ALL_OUTPUTS) == ("bmode", "echo", "transmittance", "coverage", "labels")


@pytest.mark.parametrize("outputs", [[], ["bmod"], "b-mode", ["bmode", ""], [None]])
def test_other_outputs_are_refused(outputs: Any) -> None:
    with pytest.raises(UnknownOutput, match="bmode, echo, transmittance, coverage, labels") as caught:
        check_outputs(outputs)
    assert caught.value.field == "outputs"


def test_labels_need_a_scene_that_has_them() -> None:
    check_labelled(("bmode", "labels"), SceneInfo(label_names={3: "fat"}))
    check_labelled(("bmode",), SceneInfo())
    with pytest.raises(UnknownOutput, match="only for a scene whose Gaussians carry labels") as caught:
        check_labelled(("bmode", "labels"), SceneInfo())
    assert caught.value.field == "outputs"


@pytest.mark.parametrize("side", [1, 512, MAX_IMAGE_SIDE, np.int64(7)])
def test_sizes_within_the_limit(side: Any) -> None:
    check_image_size(side, 1)
    check_image_size(1, side)


@pytest.mark.parametrize("side", [0, -1, MAX_IMAGE_SIDE + 1, 1.0, "512", None, True, float("nan")])
@pytest.mark.parametrize("field", ["height", "width"])
def test_other_sizes_are_refused_by_name(side: Any, field: str) -> None:
    with pytest.raises(InvalidImageSize, match=f"^{field} must be an integer from 1 to {MAX_IMAGE_SIDE}") as caught:
        check_image_size(**{"height": 8, "width": 8, field: side})
    assert caught.value.field == field


def test_a_service_may_set_a_lower_limit() -> None:
    with pytest.raises(InvalidImageSize, match="from 1 to 100"):
        check_image_size(101, 8, limit=100)
