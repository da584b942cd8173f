"""The image loss against an independent SSIM and closed forms, the kernel's against plain torch in float64."""

import pytest
import torch
from pytorch_msssim import ssim as other_ssim

from ultragray.learn.training.losses import absorption_loss, image_loss, kernel_image_loss, plain_image_loss, ssim
from ultragray.rendering.backends import cpu


def test_ssim_agrees_with_another_implementation():
    generator = torch.Generator().manual_seed(0)
    x = torch.rand((3, 24, 17), generator=generator)
    y = (x + 0.2 * torch.randn(x.shape, generator=generator)).clamp(0, 1)
    expected = other_ssim(x[:, None], y[:, None], data_range=1.0, win_size=11, win_sigma=1.5)
    assert float(ssim(x, y)) == pytest.approx(float(expected), abs=1e-6)


def test_loss_of_constant_frames():
    # SSIM of constants a, b is (2ab + C1)/(a² + b² + C1): there is no variance.
    a, b = torch.full((2, 11, 12), 0.25, dtype=torch.float64), torch.full((2, 11, 12), 0.75, dtype=torch.float64)
    dissimilarity = 1.0 - (2 * 0.25 * 0.75 + 1e-4) / (0.25**2 + 0.75**2 + 1e-4)
    for texture in (0.0, 0.3, 1.0):
        expected = (1.0 - texture) * 0.5 + texture * dissimilarity
        assert float(image_loss(a, b, texture)) == pytest.approx(expected, abs=1e-9)
        assert float(image_loss(a, a, texture)) == pytest.approx(0.0, abs=1e-9)


def test_gradient():
    generator = torch.Generator().manual_seed(1)
    x, y = torch.rand((2, 1, 12, 13), generator=generator, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda rendered: image_loss(rendered, y, 0.3), (x.requires_grad_(),))


def test_truth_of_another_dtype_does_not_reach_the_kernel():
    generator = torch.Generator().manual_seed(3)
    x, y = torch.rand((2, 1, 12, 13), generator=generator)
    expected = float(plain_image_loss(x.double(), y.double(), 0.3))
    assert float(image_loss(x, y.double(), 0.3)) == pytest.approx(expected, abs=1e-7)
    assert float(image_loss(x.double(), y, 0.3)) == pytest.approx(expected, abs=1e-7)


def test_windows_are_not_left_to_cudnn(monkeypatch):
    """It would round to ten bits, and a variance is the small difference of two means; see `metrics._smooth`."""
    true_conv2d, groups = torch.nn.functional.conv2d, []

    def watched(fields, window, **options):
        groups.append((options["groups"], fields.shape[1]))
        return true_conv2d(fields, window, **options)

    monkeypatch.setattr(torch.nn.functional, "conv2d", watched)
    ssim(torch.rand(2, 12, 13, requires_grad=True), torch.rand(2, 12, 13))
    assert groups == [(5, 5), (5, 5)]


@pytest.mark.parametrize("shape", [(3, 40, 53), (1, 11, 11), (2, 64, 16), (1, 12, 300)])
@pytest.mark.parametrize("instruction_set", cpu.INSTRUCTION_SETS)
@pytest.mark.parametrize("texture", [0.0, 0.3, 1.0])
def test_value_and_gradient(shape, instruction_set, texture):
    generator = torch.Generator().manual_seed(4)
    truth = torch.rand(shape, generator=generator)
    rendered = (truth + 0.2 * torch.randn(shape, generator=generator)).clamp(0.0, 1.0)
    exact = rendered.double().requires_grad_()
    expected = plain_image_loss(exact, truth.double(), texture)
    expected.backward()
    rendered.requires_grad_()
    loss = kernel_image_loss(rendered, truth, texture, instruction_set=instruction_set)
    (3.0 * loss).backward()
    assert loss.item() == pytest.approx(expected.item(), abs=1e-6)
    assert torch.allclose(
        rendered.grad.double(), 3.0 * exact.grad, rtol=1e-3, atol=1e-6 * exact.grad.abs().max().item()
    )


@pytest.mark.parametrize("instruction_set", cpu.INSTRUCTION_SETS)
def test_weights_count_for_the_last_images(instruction_set):
    rendered, truth = torch.rand((2, 3, 17, 21), generator=torch.Generator().manual_seed(5))
    weights = torch.rand((2, 17, 21), generator=torch.Generator().manual_seed(6))
    exact = rendered.double().requires_grad_()
    expected = plain_image_loss(exact, truth.double(), 0.3, weights.double())
    expected.backward()
    loss = kernel_image_loss(rendered.requires_grad_(), truth, 0.3, weights, instruction_set=instruction_set)
    loss.backward()
    assert loss.item() == pytest.approx(expected.item(), abs=1e-6)
    assert torch.allclose(rendered.grad.double(), exact.grad, rtol=1e-3, atol=1e-6 * exact.grad.abs().max().item())
    assert loss.item() != pytest.approx(plain_image_loss(exact, truth.double(), 0.3).item(), abs=1e-3)


def test_absorption_has_a_price_where_neither_neighbour_shows_a_shadow():
    transmittance = torch.rand((3, 5, 7), generator=torch.Generator().manual_seed(7))
    shadowed = torch.rand((4, 5, 7), generator=torch.Generator().manual_seed(8)) < 0.3
    neighbours = torch.tensor([[0, 0], [1, 3], [2, 1]])
    exact = transmittance.double().requires_grad_()
    expected = absorption_loss(exact, shadowed, neighbours, 0.2)
    (2.0 * expected).backward()
    loss = absorption_loss(transmittance.requires_grad_(), shadowed, neighbours, 0.2)
    (2.0 * loss).backward()
    free = ~(shadowed[neighbours[:, 0]] | shadowed[neighbours[:, 1]])
    by_hand = 0.2 * (1.0 - exact.detach())[free].sum().item() / exact.numel()
    assert expected.item() == pytest.approx(by_hand, abs=1e-9)
    assert loss.item() == pytest.approx(by_hand, abs=1e-6)
    assert torch.allclose(transmittance.grad.double(), exact.grad, atol=1e-7)


@pytest.mark.parametrize("shape", [(1, 10, 20), (1, 20, 10), (0, 20, 20)])
def test_images_smaller_than_the_window_are_refused(shape):
    with pytest.raises(ValueError, match="11x11"):
        kernel_image_loss(torch.rand(shape), torch.rand(shape), 0.5)
