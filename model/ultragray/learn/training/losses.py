"""The image part of the training loss by the C++ kernel (docs/physics.md §7): forward and gradient in one pass."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ultragray import _cpu
from ultragray.learn.evaluation.metrics import WINDOW, ssim_maps


def kernel_image_loss(rendered: Tensor, truth: Tensor, texture: float, *, instruction_set: str = "auto") -> Tensor:
    """(1 − texture)·mean|rendered − truth| + texture·(1 − SSIM) of float32 images [C, H, W] on the CPU.

    Sides have at least 11 pixels. SSIM is taken with a Gaussian window of 11x11 pixels, σ = 1.5, where the window lies
    inside the image.
    Differentiable with respect to `rendered`. Raises ValueError for smaller images.
    """
    loss: Tensor = _ImageLoss.apply(rendered, truth, texture, instruction_set)  # type: ignore[no-untyped-call]
    return loss


class _ImageLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rendered: Tensor, truth: Tensor, texture: float, instruction_set: str) -> Tensor:
        x = rendered.detach().contiguous()
        gradient = torch.empty_like(x)
        value = _cpu.image_loss(
            x.numpy(), truth.contiguous().numpy(), gradient.numpy(), texture, torch.get_num_threads(), instruction_set
        )
        ctx.gradient = gradient
        return x.new_tensor(value)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_loss: Tensor) -> tuple[Tensor, None, None, None]:
        return ctx.gradient * by_loss, None, None, None


SSIM_WINDOW = WINDOW


def image_loss(rendered: Tensor, truth: Tensor, texture: float) -> Tensor:  # [C, H, W] both, in [0, 1] -> scalar
    """(1 − texture)·mean|rendered − truth| + texture·(1 − SSIM), both sides at least 11 pixels, on any device.

    Where both images are float32 on the CPU, the C++ kernel computes it.
    """
    if all(image.device.type == "cpu" and image.dtype == torch.float32 for image in (rendered, truth)):
        return kernel_image_loss(rendered, truth, texture)
    return plain_image_loss(rendered, truth, texture)


def plain_image_loss(rendered: Tensor, truth: Tensor, texture: float) -> Tensor:  # [C, H, W] both -> scalar
    """The definition of `image_loss`."""
    return (1.0 - texture) * (rendered - truth).abs().mean() + texture * (1.0 - ssim(rendered, truth))


def ssim(x: Tensor, y: Tensor) -> Tensor:  # [C, H, W], [C, H, W] -> scalar
    """Mean structural similarity: Gaussian window 11x11, σ = 1.5, only where the window lies inside (valid padding)."""
    luminance, contrast = ssim_maps(x[:, None], y[:, None])
    return (luminance * contrast).mean()
