"""The kernel's loss against the same in plain torch, float64."""

import pytest
import torch

from ultragray.learn.training.losses import kernel_image_loss, plain_image_loss
from ultragray.rendering.backends import cpu


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


@pytest.mark.parametrize("shape", [(1, 10, 20), (1, 20, 10), (0, 20, 20)])
def test_images_smaller_than_the_window_are_refused(shape):
    with pytest.raises(ValueError, match="11x11"):
        kernel_image_loss(torch.rand(shape), torch.rand(shape), 0.5)
