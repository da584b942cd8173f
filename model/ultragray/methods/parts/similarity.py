"""SSIM and MS-SSIM as losses, with the windows and constants that each paper uses."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)  # Wang, Simoncelli and Bovik (2003), finest first


@dataclass(frozen=True)
class Similarity:
    """A Gaussian window and its constants, for images in [0, 1]."""

    window: int = 11  # pixels
    sigma: float = 1.5
    k1: float = 0.01
    k2: float = 0.03
    is_padded: bool = False  # with zeros, so that each pixel has a window; else only windows within the image count

    def ssim(self, x: Tensor, y: Tensor) -> Tensor:  # [C, H, W] both -> scalar
        """The mean of SSIM over all windows."""
        luminance, contrast = self._maps(x[:, None], y[:, None])
        return (luminance * contrast).mean()

    def ms_ssim(self, x: Tensor, y: Tensor, scales: int = len(SCALE_WEIGHTS)) -> Tensor:  # [C, H, W] both -> scalar
        """The mean over the images of MS-SSIM on as many of `scales` as hold a window, their weights adding to 1."""
        x, y = x[:, None], y[:, None]
        held = 1
        while held < scales and min(x.shape[-2:]) // 2**held >= self.window:
            held += 1
        weights = torch.tensor(SCALE_WEIGHTS[:held], dtype=x.dtype, device=x.device)
        factors = []
        for scale in range(held):
            luminance, contrast = self._maps(x, y)
            coarsest = scale == held - 1
            factors.append((luminance * contrast if coarsest else contrast).mean(dim=(1, 2, 3)).clamp_min(1e-6))
            x, y = functional.avg_pool2d(x, 2), functional.avg_pool2d(y, 2)
        return (torch.stack(factors, dim=1) ** (weights / weights.sum())).prod(dim=1).mean()

    def _maps(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:  # [C, 1, H, W] -> two of it
        c1, c2 = self.k1**2, self.k2**2
        fields = self._blurred(torch.cat([x, y, x * x, y * y, x * y], dim=1))
        mean_x, mean_y, mean_xx, mean_yy, mean_xy = torch.chunk(fields, 5, dim=1)
        luminance = (2.0 * mean_x * mean_y + c1) / (mean_x.square() + mean_y.square() + c1)
        variances = mean_xx - mean_x.square() + mean_yy - mean_y.square()
        return luminance, (2.0 * (mean_xy - mean_x * mean_y) + c2) / (variances + c2)

    def _blurred(self, fields: Tensor) -> Tensor:  # [C, 5, H, W]
        offsets = torch.arange(self.window, dtype=fields.dtype, device=fields.device) - self.window // 2
        window = torch.softmax(-0.5 * (offsets / self.sigma).square(), dim=0).expand(5, 1, 1, self.window)
        padding = self.window // 2 if self.is_padded else 0
        rows = functional.conv2d(fields, window, padding=(0, padding), groups=5)
        return functional.conv2d(rows, window.transpose(2, 3), padding=(padding, 0), groups=5)
