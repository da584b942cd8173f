"""The image part of the training loss by the C++ kernel (docs/physics.md §7): forward and gradient in one pass."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from torch import Tensor
from torch.autograd.function import once_differentiable

from ultragray import _cpu


def kernel_image_loss(rendered: Tensor, truth: Tensor, texture: float, *, instruction_set: str = "auto") -> Tensor:
    """(1 − texture)·mean|rendered − truth| + texture·(1 − SSIM) of float32 images [C, H, W] on the CPU.

    Sides have at least 11 pixels. SSIM is taken with a Gaussian window of 11x11 pixels, σ = 1.5, where the window lies
    inside the image.
    Differentiable with respect to `rendered`. Raises ValueError for smaller images.
    """
    return _ImageLoss.apply(rendered, truth, texture, instruction_set)  # type: ignore[no-untyped-call]


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


# The loss of a rendered frame: L1 and structural dissimilarity, mixed by `texture`.
#
# Written in torch for any device and dtype; where both images are float32 on the CPU, the C++ kernel gives the same.

SSIM_WINDOW = 11
SSIM_SIGMA = 1.5
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2


def image_loss(rendered: Tensor, truth: Tensor, texture: float) -> Tensor:  # [C, H, W] both, in [0, 1] -> scalar
    """(1 − texture)·mean|rendered − truth| + texture·(1 − SSIM), both sides at least 11 pixels."""
    if all(image.device.type == "cpu" and image.dtype == torch.float32 for image in (rendered, truth)):
        return kernel_image_loss(rendered, truth, texture)
    return plain_image_loss(rendered, truth, texture)


def plain_image_loss(rendered: Tensor, truth: Tensor, texture: float) -> Tensor:  # [C, H, W] both -> scalar
    """The definition of `image_loss`."""
    return (1.0 - texture) * (rendered - truth).abs().mean() + texture * (1.0 - ssim(rendered, truth))


def ssim(x: Tensor, y: Tensor) -> Tensor:  # [C, H, W], [C, H, W] -> scalar
    """Mean structural similarity: Gaussian window 11x11, σ = 1.5, only where the window lies inside (valid padding)."""
    mean_x, mean_y, square_x, square_y, product = _blurred(torch.stack([x, y, x * x, y * y, x * y], dim=1)).unbind(1)
    variances = square_x + square_y - mean_x.square() - mean_y.square()
    covariance = product - mean_x * mean_y
    luminance = (2.0 * mean_x * mean_y + SSIM_C1) / (mean_x.square() + mean_y.square() + SSIM_C1)
    similarity: Tensor = luminance * (2.0 * covariance + SSIM_C2) / (variances + SSIM_C2)
    return similarity.mean()


def _blurred(fields: Tensor) -> Tensor:  # [C, 5, H, W] -> [C, 5, H-10, W-10]
    """The window's mean, first along columns, then along rows.

    One group a field: cuDNN, which by default rounds the factors of a convolution to ten bits (TF32), is not asked
    then, and a variance, the small difference of two such means, keeps its digits.
    """
    groups = fields.shape[1]
    offsets = torch.arange(SSIM_WINDOW, dtype=fields.dtype, device=fields.device) - SSIM_WINDOW // 2
    window = torch.softmax(-0.5 * (offsets / SSIM_SIGMA).square(), dim=0).expand(groups, 1, SSIM_WINDOW)
    return F.conv2d(F.conv2d(fields, window[..., None], groups=groups), window[:, :, None], groups=groups)
