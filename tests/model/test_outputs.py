"""Outputs, as asked for."""

import numpy as np
import pytest
import torch

from ultragray.errors import UnknownOutput
from ultragray.exchange.exports.exporter import stored_pixels
from ultragray.rendering.outputs import OUTPUTS, Output, check_outputs
from ultragray.rendering.pixels import to_uint8
from ultragray_workers.pool.pixels import render_to_host, round_to_uint8


def test_outputs_keep_their_order_without_repetitions():
    assert check_outputs(["coverage", "bmode", "coverage"]) == ("coverage", "bmode")
    assert check_outputs("echo") == ("echo",)
    assert check_outputs(tuple(OUTPUTS)) == tuple(OUTPUTS)


@pytest.mark.parametrize("outputs", [[], ["bmod"], "b-mode", ["bmode", ""], [None]])
def test_other_outputs_are_refused(outputs):
    with pytest.raises(UnknownOutput, match=", ".join(OUTPUTS)) as caught:
        check_outputs(outputs)
    assert caught.value.field == "outputs"


def test_eight_bits_hold_the_shares_of_a_scale(tmp_path, monkeypatch):
    level = Output(
        "level", "echo in dB", ("echo",), lambda drawing: drawing.plane("echo"), unit="dB", scale=(-60.0, 0.0)
    )
    monkeypatch.setitem(OUTPUTS, "level", level)
    values = np.array([[-80.0, -60.0, -30.0], [-1.0, 0.0, 3.0]], np.float32)[None]
    expected = np.array([[0, 0, 128], [251, 255, 255]], np.uint8)[None]
    np.testing.assert_array_equal(stored_pixels("level", values, np.dtype("u1")), expected)
    np.testing.assert_array_equal(stored_pixels("level", values, np.dtype("<f4")), values)
    np.testing.assert_array_equal(round_to_uint8(level.shares(torch.from_numpy(values))), expected)
    on_host = render_to_host(
        lambda poses: {"level": torch.from_numpy(values)},
        np.eye(4)[None],
        {"level": {np.dtype("u1"), np.dtype("<f4")}},
        torch.device("cpu"),
    )
    np.testing.assert_array_equal(to_uint8(on_host.take("level", np.dtype("u1"), 0, 1)), expected)
    np.testing.assert_array_equal(on_host.take("level", np.dtype("<f4"), 0, 1), values)
    assert (level.about, level.range_in_words) == ("echo in dB; -60 to 0 dB", "-60 to 0 dB")
    shares = np.ones((1, 1, 2), np.float32)
    assert OUTPUTS["bmode"].shares(shares) is shares
    assert OUTPUTS["labels"].range_in_words == "whole numbers"
