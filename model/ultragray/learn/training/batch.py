"""What one step of a training is taken on: frames of the sweep, with views between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ultragray.geometry.probe import FloatArray, ScanLines
from ultragray.learn.sweep import Sweep
from ultragray.learn.training.between import ViewsBetween
from ultragray.learn.training.config import TrainingConfig
from ultragray.learn.training.geometry import out_of_plane_shift_mm, shift_out_of_plane
from ultragray.learn.training.losses import SSIM_WINDOW, absorption_loss, image_loss
from ultragray.rendering.backends import cuda
from ultragray.rendering.frames import Frames


@dataclass(frozen=True, eq=False)
class Batch:
    """Poses to render, and what they should show."""

    poses: FloatArray  # [B, 4, 4] mm
    nearest: Tensor  # [B], the frame that each is, or lies nearest to
    neighbours: Tensor  # [B, 2], the frames that each lies between
    truth: Tensor  # [B, H, W] in [0, 1]
    weights: Tensor | None  # [B, H, W], of the views between the frames, the last ones; None: there are none

    @classmethod
    def of(
        cls,
        train: Sweep,
        images: Tensor,  # [F, H, W] uint8, those of the sweep where the training is
        own: Tensor,  # [K] frames
        between: ViewsBetween | None,
        count: int,  # of the views between
        config: TrainingConfig,
        generator: torch.Generator,
    ) -> Batch:
        poses, nearest, neighbours = train.poses[own.numpy()], own, own[:, None].expand(-1, 2)
        truth, weights = [_grey_values(images, own)], None
        if between is not None:
            views = between.draw(count, generator)
            poses = np.concatenate([poses, views.poses])
            nearest = torch.cat([own, torch.from_numpy(views.places.nearer)])
            neighbours = torch.cat([neighbours, torch.from_numpy(views.places.frames)])
            truth, weights = [*truth, views.images], views.weights
        if config.out_of_plane_mm:
            poses = shift_out_of_plane(poses, out_of_plane_shift_mm(config.out_of_plane_mm, generator))
        return cls(poses, nearest, neighbours, _joined(truth), weights)

    @property
    def can_be_halved(self) -> bool:
        height, width = self.truth.shape[1:]
        return height % 2 == width % 2 == 0 and min(height, width) >= 2 * SSIM_WINDOW

    def halved(self, shadowed: Tensor) -> tuple[Batch, Tensor]:  # [F, H, W] -> [F', H / 2, W / 2]
        """With images of half as many rows and columns, and the shadows of its neighbours likewise."""
        used, neighbours = torch.unique(self.neighbours, return_inverse=True)
        weights = None if self.weights is None else avg_pool2d(self.weights, 2)
        halved = replace(self, truth=avg_pool2d(self.truth, 2), weights=weights, neighbours=neighbours)
        return halved, shadowed[used.to(shadowed.device), ::2, ::2].contiguous()

    def of_lines(self, lines: ScanLines, first: int, every: int, shadowed: Tensor) -> tuple[Batch, Tensor]:
        """With every so-manyth of the scan lines, from the first one told, which their number must be a multiple of:
        all lines of a probe that is moved. The shadows of its neighbours likewise, [F, H, W] -> [F', H, W / every].
        """
        used, neighbours = torch.unique(self.neighbours, return_inverse=True)
        across = lines.span * (first + 0.5 - every / 2) / self.truth.shape[2]
        some = replace(
            self,
            poses=self.poses @ lines.moved(across),
            truth=self.truth[..., first::every].contiguous(),
            weights=None if self.weights is None else self.weights[..., first::every].contiguous(),
            neighbours=neighbours,
        )
        return some, shadowed[used.to(shadowed.device)][..., first::every].contiguous()

    def loss(self, frames: Frames, shadowed: Tensor | None, config: TrainingConfig) -> Tensor:
        """How far frames are from what they should show, and the price of absorption but in `shadowed` pixels of the
        neighbours, [F, H, W]; None: it has none.
        """
        assert config.texture is not None
        loss = image_loss(frames["bmode"], self.truth, config.texture, self.weights)
        if shadowed is None:
            return loss
        neighbours = cuda.upload(self.neighbours, shadowed.device)
        return loss + absorption_loss(frames["transmittance"], shadowed, neighbours, config.absorption_penalty)


def _grey_values(images: Tensor, frames: Tensor) -> Tensor:  # [F, H, W] uint8, [K] -> [K, H, W] in [0, 1]
    """Frames in float32. On a CPU by numpy, here and below: torch's threads would fight with the kernel's, and took a
    tenth of a step on a busy machine.
    """
    if images.device.type == "cpu":
        return torch.from_numpy(images.numpy()[frames.numpy()] / np.float32(255.0))
    return images[cuda.upload(frames, images.device)].float().div_(255.0)


def _joined(parts: Sequence[Tensor]) -> Tensor:
    if len(parts) == 1:
        return parts[0]
    return torch.from_numpy(np.concatenate(parts)) if parts[0].device.type == "cpu" else torch.cat(list(parts))
