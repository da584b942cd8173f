"""Ultra-NeRF: its field, its renderer against products by hand, its variants."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from torch.nn import functional

from ultragray import ConvexProbe, LinearProbe
from ultragray.errors import DatasetInvalid
from ultragray.learn.sweep import Dataset, Sweep
from ultragray_studies.methods.method import Budget
from ultragray_studies.methods.parts import encode
from ultragray_studies.methods.ultranerf import (
    VARIANTS,
    Coordinates,
    Tissue,
    TissueField,
    drawn_frame,
    expected_frame,
    point_spread,
    transmission,
)


def field(seed=0):
    return TissueField(torch.Generator().manual_seed(seed))


def test_a_point_becomes_itself_and_ten_octaves_of_sines_and_cosines():
    point = torch.tensor([math.pi / 2, 0.0, -math.pi / 4], dtype=torch.float64)
    encoded = encode(point)
    assert encoded.shape == (63,)
    half = math.sqrt(0.5)
    expected = [*point.tolist(), 1.0, 0.0, -half, 0.0, 1.0, half]  # p, then sin p and cos p
    expected += [0.0, 0.0, -1.0, -1.0, 1.0, 0.0]  # sin 2p, cos 2p
    torch.testing.assert_close(encoded[:15], torch.tensor(expected, dtype=torch.float64))
    torch.testing.assert_close(encoded[-6:-3], torch.sin(512.0 * point))
    torch.testing.assert_close(encoded[-3:], torch.cos(512.0 * point))


def test_the_encoding_joins_again_before_the_sixth_layer():
    module = field()
    layers = [one for one in module.modules() if isinstance(one, torch.nn.Linear)]
    assert [(one.in_features, one.out_features) for one in layers] == [
        (63, 128), *[(128, 128)] * 4, (191, 128), *[(128, 128)] * 2, (128, 5)
    ]  # fmt: skip
    with torch.no_grad():
        layers[4].weight.zero_()  # what came before the joint is gone
        raw = module(torch.rand(8, 3, generator=torch.Generator().manual_seed(0)))
    assert raw.shape == (8, 5)
    assert raw.std(dim=0).min() > 0.0


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


def test_a_border_that_returns_everything_leaves_finite_gradients():
    raw = raw_numbers().float()
    raw[3, :, 1:3] = 200.0  # β and ρ_b are exactly 1
    raw.requires_grad_()
    (gradient,) = torch.autograd.grad(expected_frame(Tissue.of(raw), SPACING).sum(), raw)
    assert gradient.isfinite().all()


SIDE = 24
LINEAR = LinearProbe(width_mm=20.0, near_mm=0.0, far_mm=20.0)
CPU = torch.device("cpu")


def sweep(probe=LINEAR, frames=3, height=SIDE, width=SIDE):
    """Frames 1 mm apart with a bright bow that shadows what lies under it."""
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 1, 3] = np.arange(frames)
    row, column = np.mgrid[0:height, 0:width] / (height, width)[0]
    bow = 0.4 + 0.3 * (column - 0.5) ** 2
    tissue = 70.0 + 25.0 * np.sin(9.0 * column + 2.0) * np.cos(11.0 * row)
    image = np.where((row > bow) & (np.abs(column - 0.4) < 0.25), 20.0, tissue)
    image += 110.0 * np.exp(-(((row - bow) / 0.05) ** 2)) * (np.abs(column - 0.4) < 0.25)
    images = np.stack([np.clip(image - 3.0 * place, 0, 255) for place in range(frames)]).astype(np.uint8)
    return Sweep(images, poses, probe, np.arange(frames), "bow")


def dataset(probe=LINEAR, frames=3, **size):
    train = sweep(probe, frames, **size)
    return Dataset("bow", train, train.select([0]))


def learner(method, of=None, seed=0):
    return method.learner(of or dataset(), Budget.author(), seed, CPU)


def test_the_field_sees_metres_or_the_scaled_box():
    train = sweep()
    corner = np.array([10.0, 2.0, 20.0])
    np.testing.assert_allclose(Coordinates.metres(train).of(corner), [0.010, 0.002, 0.020])
    np.testing.assert_allclose(Coordinates.scaled(train).of(corner), [1.0, 0.1, 1.0])
    np.testing.assert_allclose(Coordinates.scaled(train).of(np.array([-10.0, 0.0, 0.0])), [-1.0, -0.1, -1.0])


@pytest.mark.parametrize(("name", "length"), [("ultranerf-released", 0.020), ("ultranerf-unit", 2.0)])
def test_attenuation_is_counted_per_unit_of_the_coordinates(name, length):
    """A field of constant attenuation 1.5, no reflection, and scatterers of amplitude 1: I = exp(−1.5 depth)."""
    one = learner(next(one for one in VARIANTS if one.name == name))
    with torch.no_grad():
        one.module.head.weight.zero_()
        one.module.head.bias.copy_(torch.tensor([-1.5, -100.0, -100.0, 100.0, 100.0]))
    frame = one.render(LINEAR, np.eye(4)[None], SIDE, SIDE)[0]
    middle = frame[3:-3, SIDE // 2]
    expected = np.exp(-1.5 * length * np.arange(3, SIDE - 3) / SIDE)
    np.testing.assert_allclose(middle, expected, rtol=1e-5)


def test_a_fan_is_rendered_along_its_own_scan_lines():
    probe = ConvexProbe(opening_angle_deg=60.0, near_mm=20.0, far_mm=60.0)
    one = learner(VARIANTS[1], dataset(probe, width=20))
    assert math.isfinite(one.take_step(0, 10))
    with torch.no_grad():
        one.module.head.weight.zero_()
        one.module.head.bias.copy_(torch.tensor([1.0, -100.0, -100.0, 100.0, 100.0]))
    frame = one.render(probe, np.eye(4)[None], SIDE, 20)[0]
    half_mm = one.coordinates.unit_mm
    expected = np.exp(-40.0 / half_mm * np.arange(3, SIDE - 3) / SIDE)  # along each line alike
    for column in (3, 10, 16):
        np.testing.assert_allclose(frame[3:-3, column], expected, rtol=1e-5)


def test_the_rate_falls_as_published_over_the_steps_of_any_budget():
    one = learner(VARIANTS[1])
    rates = []
    for step, steps in ((0, 10), (5, 10), (100_000, 200_000), (250, 250)):
        one.loss(step, steps)
        rates.append(one.optimizers["adam"].param_groups[0]["lr"])
    assert rates == pytest.approx([1e-4, 1e-4 * 0.1**0.4, 1e-4 * 0.1 ** (100_000 / 250_000), 1e-4 * 0.1**0.8])


def test_frames_too_small_for_the_loss_are_refused():
    with pytest.raises(DatasetInvalid, match="at least 7 pixels a side, got 24x6"):
        learner(VARIANTS[0], dataset(width=6))


@pytest.mark.long
def test_the_mean_variant_learns_a_single_frame_by_heart():
    train = sweep(frames=2)
    same = replace(train, images=train.images[[0, 0]], poses=train.poses[[0, 0]])
    one = learner(VARIANTS[2], Dataset("one", same, same.select([])))
    for step in range(700):
        one.take_step(step, 2000)
    frame = one.render(LINEAR, same.poses[:1], SIDE, SIDE)[0]
    assert -10.0 * math.log10(float(((frame - same.images[0] / 255.0) ** 2).mean())) > 30.0
