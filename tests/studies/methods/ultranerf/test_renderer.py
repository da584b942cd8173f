"""The renderer of Ultra-NeRF, against products by hand, and which of its maps get gradients."""

import math
from dataclasses import fields, replace

import pytest
import torch
from torch.nn import functional

from ultragray_studies.methods.ultranerf import Tissue, drawn_frame, expected_frame, point_spread, transmission

SPACING = 0.5


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def raw_numbers(height=12, width=9):  # [H, W, 5]
    return torch.randn(height, width, 5, generator=generator(), dtype=torch.float64)


def blank(height, width):
    """Tissue that neither attenuates nor reflects, full of scatterers of amplitude 1."""
    zero, one = (torch.full((height, width), value, dtype=torch.float64) for value in (0.0, 1.0))
    return Tissue(attenuation=zero, reflectance=zero, border=zero, scatterer=one, amplitude=one)


def test_the_five_maps_follow_from_the_raw_numbers():
    tissue = Tissue.of(torch.tensor([[[-2.0, 0.0, math.log(3.0), -math.log(3.0), math.log(9.0)]]]))
    found = [float(getattr(tissue, item.name)) for item in fields(tissue)]
    assert found == pytest.approx([2.0, 0.5, 0.75, 0.25, 0.9])


def test_a_sample_sees_the_product_of_all_shallower_ones_and_not_its_own():
    """Four samples along two scan lines."""
    attenuation = torch.tensor([[0.2, 0.0], [0.4, 1.0], [0.0, 3.0], [9.0, 9.0]], dtype=torch.float64)
    reflectance = torch.tensor([[0.5, 0.1], [0.5, 1.0], [0.2, 0.5], [0.9, 0.9]], dtype=torch.float64)
    border = torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.5, 0.0], [1.0, 1.0]], dtype=torch.float64)
    tissue = replace(blank(4, 2), attenuation=attenuation, reflectance=reflectance)
    expected = [
        [1.0, 1.0],
        [math.exp(-0.1) * 0.5, 1.0],
        [math.exp(-0.3) * 0.5, 0.0],  # the second line meets a border that returns all of it
        [math.exp(-0.3) * 0.5 * 0.9, 0.0],
    ]
    torch.testing.assert_close(transmission(tissue, border, SPACING), torch.tensor(expected, dtype=torch.float64))


def test_the_point_spread_sums_to_one_and_its_wide_axis_is_lateral():
    kernel = point_spread(torch.zeros((), dtype=torch.float64))
    assert kernel.shape == (7, 7)
    assert float(kernel.sum()) == pytest.approx(1.0)
    centre = kernel[3, 3]
    assert float(kernel[4, 3] / centre) == pytest.approx(math.exp(-0.5))  # down a column: depth, 1 pixel
    assert float(kernel[3, 4] / centre) == pytest.approx(math.exp(-0.125))  # along a row: scan lines, 2 pixels


def test_scatterers_without_attenuation_and_borders_are_blurred_amplitudes():
    amplitude = torch.rand(10, 11, generator=generator(), dtype=torch.float64)
    tissue = replace(blank(10, 11), amplitude=amplitude)
    blurred = functional.conv2d(amplitude[None, None], point_spread(amplitude)[None, None], padding=3)[0, 0]
    torch.testing.assert_close(expected_frame(tissue, SPACING), blurred)
    torch.testing.assert_close(drawn_frame(tissue, SPACING, generator()), blurred)


def test_a_border_is_seen_at_once_and_shadows_what_lies_under_it():
    border = torch.zeros(20, 21, dtype=torch.float64)
    border[10, 10] = 1.0
    tissue = replace(blank(20, 21), border=border, reflectance=torch.full_like(border, 0.4))
    frame = expected_frame(replace(tissue, scatterer=torch.zeros_like(border)), SPACING)
    assert float(frame[10, 10]) == pytest.approx(0.4 * float(point_spread(border)[3, 3]))
    assert float(frame[11, 10]) == pytest.approx(0.6 * 0.4 * float(point_spread(border)[4, 3]))
    lit = expected_frame(tissue, SPACING)
    assert float(lit[16, 10]) == pytest.approx(0.6)
    assert float(lit[16, 9]) == pytest.approx(1.0)


def test_the_mean_of_many_draws_is_the_expected_scattering():
    tissue = Tissue.of(raw_numbers(6, 5))
    silent = replace(tissue, amplitude=torch.zeros_like(tissue.amplitude))
    draws = generator(5)
    count = 1000
    mean = torch.zeros_like(tissue.border)
    for _ in range(count):
        same = generator().set_state(draws.get_state())
        mean += drawn_frame(tissue, SPACING, draws) - drawn_frame(silent, SPACING, same)  # without the reflection
    expected = expected_frame(tissue, SPACING) - expected_frame(silent, SPACING)
    assert float((mean / count - expected).abs().max()) < 0.04


def test_drawn_probabilities_get_no_gradient_and_expected_ones_do():
    raw = raw_numbers().requires_grad_()
    (drawn,) = torch.autograd.grad(drawn_frame(Tissue.of(raw), SPACING, generator()).sum(), raw)
    reached = drawn.abs().amax(dim=(0, 1)) > 0.0
    assert reached.tolist() == [True, True, False, False, True]  # a, b, p_b, p_s, s
    (expected,) = torch.autograd.grad(expected_frame(Tissue.of(raw), SPACING).sum(), raw)
    assert (expected.abs().amax(dim=(0, 1)) > 0.0).all()


def test_the_expected_frame_has_the_gradients_of_its_formula():
    raw = raw_numbers(4, 3).requires_grad_()
    assert torch.autograd.gradcheck(_expected_of_raw, (raw,))


def test_a_border_that_returns_everything_leaves_finite_gradients():
    raw = raw_numbers().float()
    raw[3, :, 1:3] = 200.0  # β and ρ_b are exactly 1
    raw.requires_grad_()
    (gradient,) = torch.autograd.grad(expected_frame(Tissue.of(raw), SPACING).sum(), raw)
    assert gradient.isfinite().all()


def _expected_of_raw(raw):
    return expected_frame(Tissue.of(raw), SPACING)
