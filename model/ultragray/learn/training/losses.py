"""The training loss (docs/physics.md §7): by the C++ kernel, value and gradient in one pass, and its definition."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ultragray import _cpu
from ultragray.learn.evaluation.metrics import WINDOW, ssim_maps


def kernel_image_loss(
    rendered: Tensor, truth: Tensor, texture: float, weights: Tensor | None = None, *, instruction_set: str = "auto"
) -> Tensor:
    """`image_loss` of float32 images on the CPU. Raises ValueError for images smaller than 11 pixels."""
    loss: Tensor = _ImageLoss.apply(rendered, truth, texture, weights, instruction_set)  # type: ignore[no-untyped-call]
    return loss


class _Loss(torch.autograd.Function):
    """A scalar whose gradient by its first argument is known with it."""

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_loss: Tensor) -> tuple[Tensor | None, ...]:
        factor = float(by_loss.numpy())
        by_images = ctx.gradient if factor == 1.0 else ctx.gradient * factor
        return by_images, *[None] * (len(ctx.needs_input_grad) - 1)


class _ImageLoss(_Loss):
    @staticmethod
    def forward(
        ctx: Any, rendered: Tensor, truth: Tensor, texture: float, weights: Tensor | None, instruction_set: str
    ) -> Tensor:
        x = rendered.detach().contiguous()
        ctx.gradient = torch.empty_like(x)
        value = _cpu.image_loss(
            x.numpy(),
            truth.contiguous().numpy(),
            ctx.gradient.numpy(),
            texture,
            torch.get_num_threads(),
            instruction_set,
            None if weights is None else weights.contiguous().numpy(),
        )
        return x.new_tensor(value)


class _AbsorptionLoss(_Loss):
    @staticmethod
    def forward(ctx: Any, transmittance: Tensor, shadowed: Tensor, neighbours: Tensor, price: float) -> Tensor:
        passed = transmittance.detach().contiguous()
        ctx.gradient = torch.empty_like(passed)
        value = _cpu.absorption_loss(
            passed.numpy(),
            shadowed.contiguous().view(torch.uint8).numpy(),
            neighbours.contiguous().numpy(),
            price,
            torch.get_num_threads(),
            ctx.gradient.numpy(),
        )
        return passed.new_tensor(value)


SSIM_WINDOW = WINDOW


def image_loss(
    rendered: Tensor,  # [C, H, W] in [0, 1], sides of at least 11 pixels
    truth: Tensor,  # [C, H, W] in [0, 1]
    texture: float,
    weights: Tensor | None = None,  # [V, H, W] in [0, 1]
) -> Tensor:
    """(1 − texture)·mean|rendered − truth| + texture·(1 − SSIM), differentiable by `rendered`, on any device.

    SSIM is taken with a Gaussian window of 11x11 pixels, σ = 1.5, where the window lies inside the image. The last V
    images are mixed with their truth before, so that each pixel counts as much as its weight says. Where the images are
    float32 on the CPU, the C++ kernel computes it.
    """
    images = (rendered, truth) if weights is None else (rendered, truth, weights)
    if all(image.device.type == "cpu" and image.dtype == torch.float32 for image in images):
        return kernel_image_loss(rendered, truth, texture, weights)
    return plain_image_loss(rendered, truth, texture, weights)


def plain_image_loss(
    rendered: Tensor, truth: Tensor, texture: float, weights: Tensor | None = None
) -> Tensor:  # [C, H, W] both -> scalar
    """The definition of `image_loss`."""
    if weights is not None:
        own = len(rendered) - len(weights)
        rendered = torch.cat([rendered[:own], torch.lerp(truth[own:], rendered[own:], weights)])
    return (1.0 - texture) * (rendered - truth).abs().mean() + texture * (1.0 - ssim(rendered, truth))


def absorption_loss(
    transmittance: Tensor,  # [C, H, W]
    shadowed: Tensor,  # [F, H, W] bool, pixels of frames that lie in a shadow
    neighbours: Tensor,  # [C, 2] the two frames on either side of each
    price: float,
) -> Tensor:
    """price·mean(1 − T), in which pixels count 0 where a frame on either side shows a shadow; on any device."""
    if transmittance.device.type == "cpu" and transmittance.dtype == torch.float32:
        loss: Tensor = _AbsorptionLoss.apply(transmittance, shadowed, neighbours, price)  # type: ignore[no-untyped-call]
        return loss
    return plain_absorption_loss(transmittance, shadowed, neighbours, price)


def plain_absorption_loss(transmittance: Tensor, shadowed: Tensor, neighbours: Tensor, price: float) -> Tensor:
    """The definition of `absorption_loss`."""
    return price * ((1.0 - transmittance) * ~shadowed[neighbours].any(dim=1)).mean()


def ssim(x: Tensor, y: Tensor) -> Tensor:  # [C, H, W], [C, H, W] -> scalar
    """Mean structural similarity: Gaussian window 11x11, σ = 1.5, only where the window lies inside (valid padding)."""
    luminance, contrast = ssim_maps(x[:, None], y[:, None])
    return (luminance * contrast).mean()
