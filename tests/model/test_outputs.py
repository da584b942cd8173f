"""Outputs, as asked for; the share of the beam that ends in each pixel."""

import numpy as np
import pytest
import torch

from ultragray import GaussianScene, LinearProbe, render
from ultragray.errors import UnknownOutput
from ultragray.exchange.exports.exporter import stored_pixels
from ultragray.rendering.outputs import OUTPUTS, SPENT_BEAM, Output, check_outputs
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


PROBE = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_what_each_pixel_takes_leaves_the_transmittance(random_scene, random_poses, backend):
    scene = random_scene(60, seed=3, sigma_cm=(0.2, 0.6))
    frames = render(
        scene,
        PROBE,
        random_poses(2, seed=1),
        height=48,
        width=40,
        outputs=("attenuation", "transmittance"),
        backend=backend,
    )
    attenuation, transmittance = frames["attenuation"], frames["transmittance"]
    assert 0.0 <= attenuation.min() <= attenuation.max() <= 1.0
    assert attenuation.max() > 0.05, "something absorbs"
    left = torch.cumprod(1.0 - attenuation, dim=1)
    falls = torch.cummin(transmittance, dim=1).values  # at the rim of a footprint T may rise by a threshold
    reached = (falls > SPENT_BEAM) & (transmittance <= falls + 1e-6)
    assert reached.float().mean() > 0.8
    assert (left - transmittance)[reached].abs().max() < 0.02


def test_a_spent_beam_has_nothing_to_lose(random_scene):
    scene = random_scene(400, seed=1, sigma_cm=(0.5, 0.9))
    scene = GaussianScene.from_splats({**scene.splats, "transmittances": torch.full((400,), -9.0)})
    frames = render(scene, PROBE, np.eye(4), height=64, width=16, outputs=("attenuation", "transmittance"))
    spent = frames["transmittance"].roll(1, dims=1)[:, 1:] < SPENT_BEAM
    assert spent.any()
    assert (frames["attenuation"][:, 1:][spent] == 0.0).all()


def test_gradients_pass_through_it(random_scene):
    scene = random_scene(20, seed=2, dtype=torch.float64)
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in scene.splats.items()}
    frames = render(GaussianScene.from_splats(leaves), PROBE, np.eye(4), height=24, width=16, outputs=("attenuation",))
    frames["attenuation"].sum().backward()
    gradient = leaves["transmittances"].grad
    assert torch.isfinite(gradient).all()
    assert (gradient < 0.0).any(), "a more transparent Gaussian takes less"
