"""Outputs, as asked for."""

from __future__ import annotations

from typing import Any

import pytest

from ultragray import SceneInfo
from ultragray.errors import UnknownOutput
from ultragray.rendering.outputs import OUTPUTS, check_available, check_outputs


def test_outputs_keep_their_order_without_repetitions() -> None:
    assert check_outputs(["coverage", "bmode", "coverage"]) == ("coverage", "bmode")
    assert check_outputs("echo") == ("echo",)
    assert check_outputs(tuple(OUTPUTS)) == tuple(OUTPUTS)


@pytest.mark.parametrize("outputs", [[], ["bmod"], "b-mode", ["bmode", ""], [None]])
def test_other_outputs_are_refused(outputs: Any) -> None:
    with pytest.raises(UnknownOutput, match=", ".join(OUTPUTS)) as caught:
        check_outputs(outputs)
    assert caught.value.field == "outputs"


def test_labels_need_a_scene_that_has_them() -> None:
    check_available(("bmode", "labels"), SceneInfo(label_names={3: "fat"}))
    check_available(("bmode",), SceneInfo())
    with pytest.raises(UnknownOutput, match="only for a scene whose Gaussians carry labels") as caught:
        check_available(("bmode", "labels"), SceneInfo())
    assert caught.value.field == "outputs"
