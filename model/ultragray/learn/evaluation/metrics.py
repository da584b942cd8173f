"""Nearness of a rendered frame to the real one: PSNR, MS-SSIM, GMS and GMSD, each per frame on [0, 1].

- PSNR = −10 log10(mean squared error), at most MAX_PSNR_DB, which identical frames get.
- MS-SSIM of Wang, Simoncelli and Bovik (2003): five scales of an 11x11 Gaussian window, σ = 1.5, constants 0.01² and
  0.03², 2x2 average pooling between scales. The coarsest scale must still hold the window, so that a side of 160 pixels
  or less leaves fewer scales, their weights renormalised to sum 1: see `ms_ssim_scales`.
- GMS, GMSD of Xue et al. (2014): mean and standard deviation over the image of (2ab + c)/(a² + b² + c), a and b the
  gradient magnitudes of the two frames after 2x2 average pooling, by Prewitt filters divided by 3 with zero padding,
  c = 170/255².
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ultragray.errors import InvalidArgument, InvalidImageSize

MAX_PSNR_DB = 100.0
SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)  # finest first
WINDOW = 11  # pixels
WINDOW_SIGMA = 1.5
SSIM_CONSTANTS = (0.01**2, 0.03**2)
GRADIENT_CONSTANT = 170.0 / 255.0**2
CHUNK_PIXELS = 1 << 22  # measured at once


@dataclass(frozen=True)
class FrameMetrics:
    """Metrics of one frame, or their mean or standard deviation over several. Higher is better but for `gmsd`."""

    psnr_db: float
    ms_ssim: float
    gms: float
    gmsd: float

    def to_dict(self) -> dict[str, float]:
        return asdict(self)

    def is_better_than(self, other: FrameMetrics) -> bool:
        higher = ("psnr_db", "ms_ssim", "gms")
        return self.gmsd < other.gmsd and all(getattr(self, name) > getattr(other, name) for name in higher)


def ms_ssim_scales(height: int, width: int) -> int:
    """The number of MS-SSIM's five scales that fit an image.

    Raises InvalidImageSize for a side under 11 pixels, which holds not even one window.
    """
    side = min(height, width)
    if side < WINDOW:
        raise InvalidImageSize(f"MS-SSIM needs images of at least {WINDOW}x{WINDOW} pixels, got {height}x{width}")
    return min(len(SCALE_WEIGHTS), 1 + int(math.log2((side - 1) / (WINDOW - 1))))


def frame_metrics(rendered: Tensor, truth: Tensor) -> list[FrameMetrics]:
    """The metrics of each of C frames; both are floating [C, H, W] in [0, 1].

    Raises InvalidArgument where the shapes differ or `rendered` is not finite, and InvalidImageSize for images smaller
    than the window of MS-SSIM.
    """
    metrics: list[FrameMetrics] = []
    for pair in _pairs(rendered, truth):
        columns = [_psnr_db(*pair), _ms_ssim(*pair), *_gradient_similarity(*pair)]
        metrics += [FrameMetrics(*values) for values in torch.stack(columns, dim=1).tolist()]
    return metrics


def ms_ssim(rendered: Tensor, truth: Tensor) -> list[float]:  # [C, H, W] both -> [C]
    """The MS-SSIM of each frame alone; takes and raises what `frame_metrics` does."""
    return [value for pair in _pairs(rendered, truth) for value in _ms_ssim(*pair).tolist()]


def _pairs(rendered: Tensor, truth: Tensor) -> Iterator[tuple[Tensor, Tensor]]:  # [C, H, W] both
    """Checked frames in float64, some at a time, [c, 1, H, W] both."""
    if rendered.ndim != 3 or rendered.shape != truth.shape:
        raise InvalidArgument(
            f"rendered and true frames must both be [C, H, W], got {list(rendered.shape)} and {list(truth.shape)}"
        )
    if not bool(torch.isfinite(rendered).all()):
        raise InvalidArgument("rendered frames must be finite, got NaN or infinity", field="rendered")
    chunk = max(1, CHUNK_PIXELS // max(1, truth.shape[1] * truth.shape[2]))
    for first in range(0, len(rendered), chunk):
        some, true = (part[first : first + chunk, None].detach().double().clamp(0.0, 1.0) for part in (rendered, truth))
        yield some, true


def mean_and_std(frames: Sequence[FrameMetrics]) -> tuple[FrameMetrics, FrameMetrics]:
    """Mean and standard deviation (divisor F) of each metric over one frame or more."""
    table = torch.tensor([tuple(frame.to_dict().values()) for frame in frames], dtype=torch.float64)  # [F, 4]
    mean, std = table.mean(dim=0), table.std(dim=0, correction=0)
    return FrameMetrics(*mean.tolist()), FrameMetrics(*std.tolist())


def _psnr_db(rendered: Tensor, truth: Tensor) -> Tensor:  # [C, 1, H, W] -> [C]
    squared = (rendered - truth).square().mean(dim=(1, 2, 3))
    return -10.0 * torch.log10(squared.clamp_min(10.0 ** (-MAX_PSNR_DB / 10.0)))


def _ms_ssim(rendered: Tensor, truth: Tensor) -> Tensor:  # [C, 1, H, W] -> [C]
    scales = ms_ssim_scales(*truth.shape[-2:])
    weights = torch.tensor(SCALE_WEIGHTS[:scales], dtype=torch.float64)
    factors = []
    for scale in range(scales):
        luminance, contrast = ssim_maps(rendered, truth)
        coarsest = scale == scales - 1
        factors.append((luminance * contrast if coarsest else contrast).mean(dim=(1, 2, 3)).clamp_min(0.0))
        if not coarsest:
            padding = [side % 2 for side in truth.shape[-2:]]
            rendered, truth = (functional.avg_pool2d(image, 2, padding=padding) for image in (rendered, truth))
    return (torch.stack(factors, dim=1) ** (weights / weights.sum())).prod(dim=1)


def ssim_maps(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:  # [C, 1, H, W] -> two of [C, 1, H-10, W-10]
    """The luminance term and the contrast-structure term; SSIM is their product."""
    c1, c2 = SSIM_CONSTANTS
    means = _smooth(torch.cat([x, y, x * x, y * y, x * y], dim=1))
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = torch.chunk(means, 5, dim=1)
    luminance = (2.0 * mean_x * mean_y + c1) / (mean_x.square() + mean_y.square() + c1)
    covariance = mean_xy - mean_x * mean_y
    variances = mean_xx - mean_x.square() + mean_yy - mean_y.square()
    return luminance, (2.0 * covariance + c2) / (variances + c2)


def _smooth(images: Tensor) -> Tensor:  # [C, 5, H, W] -> [C, 5, H-10, W-10]
    """The mean of the window: by OpenCV, in a seventh of torch's time, where neither a GPU nor a gradient is asked for.

    By torch one group a field: cuDNN, which rounds the factors of a convolution to ten bits by default (TF32), is not
    asked then, and a variance, the small difference of two such means, keeps its digits.
    """
    offsets = torch.arange(WINDOW, dtype=images.dtype, device=images.device) - WINDOW // 2
    window = torch.exp(-offsets.square() / (2.0 * WINDOW_SIGMA**2))
    window = window / window.sum()
    if images.device.type == "cpu" and not images.requires_grad:
        edge, line = WINDOW // 2, window.numpy()
        fields = images.flatten(0, 1).numpy()
        smooth: Tensor = torch.from_numpy(np.stack([cv2.sepFilter2D(one, -1, line, line) for one in fields]))
        height, width = images.shape[2:]
        return smooth[:, edge : height - edge, edge : width - edge].reshape(*images.shape[:2], height - 2 * edge, -1)
    window = window.expand(images.shape[1], 1, 1, WINDOW)
    rows = functional.conv2d(images, window.transpose(2, 3), groups=images.shape[1])
    return functional.conv2d(rows, window, groups=images.shape[1])


def _gradient_similarity(rendered: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:  # [C, 1, H, W] -> [C], [C]
    a, b = (_gradient_magnitude(functional.avg_pool2d(image, 2)) for image in (rendered, truth))
    similarity = (2.0 * a * b + GRADIENT_CONSTANT) / (a.square() + b.square() + GRADIENT_CONSTANT)
    return similarity.mean(dim=(1, 2, 3)), similarity.std(dim=(1, 2, 3), correction=0)


def _gradient_magnitude(images: Tensor) -> Tensor:  # [C, 1, H, W]
    lateral = images.new_tensor([[1.0, 0.0, -1.0]] * 3) / 3.0
    prewitt = torch.stack([lateral, lateral.T])[:, None]  # [2, 1, 3, 3]
    return functional.conv2d(images, prewitt, padding=1).square().sum(dim=1, keepdim=True).sqrt()
