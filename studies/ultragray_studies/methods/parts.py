"""What methods of other papers share: the space they learn in, the encoding of places, the similarity of frames, and
slices.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ultragray.geometry.probe import FloatArray, Probe
from ultragray.learn.sweep import Dataset, Sweep, pixel_positions_mm
from ultragray_studies.methods.learner import LearnedMethod, Learner
from ultragray_studies.methods.method import Budget


@dataclass(frozen=True, eq=False)
class Box:
    """The box, along the tracker's axes, around the corners of all training frames."""

    centre_mm: FloatArray  # [3]
    half_mm: FloatArray  # [3]

    @classmethod
    def of(cls, sweep: Sweep) -> Box:
        corners = sweep.corners_mm().reshape(-1, 3)
        low, high = corners.min(axis=0), corners.max(axis=0)
        return cls((low + high) / 2.0, (high - low) / 2.0)

    @property
    def largest_half_mm(self) -> float:
        """By which a cube around the box is scaled to [-1, 1], so that no axis is stretched."""
        return float(self.half_mm.max())


def pixel_points_mm(probe: Probe, pose: FloatArray, height: int, width: int) -> FloatArray:  # [H, W, 3]
    """The place of each pixel in the tracker's frame, mm, of a frame at a pose [4, 4]."""
    points = pixel_positions_mm(probe, height, width) @ pose[:3, :3].T + pose[:3, 3]
    pixel_points: FloatArray = points.reshape(height, width, 3)
    return pixel_points


def as_tensor(array: FloatArray, device: torch.device) -> Tensor:
    """float32 on the device."""
    return torch.from_numpy(array).to(device, torch.float32)


# Octave encoding of points: the point itself, then the sine and cosine of each coordinate times 1, 2, 4 and so on.


OCTAVES = 10


def encoded_size(octaves: int = OCTAVES) -> int:
    """The numbers that a point becomes: 63 of ten octaves."""
    return 3 * (1 + 2 * octaves)


def encode(points: Tensor, octaves: int = OCTAVES) -> Tensor:  # [..., 3] -> [..., encoded_size]
    """p, sin p, cos p, sin 2p, cos 2p and so on to 2^(octaves - 1) p; no factor π (as released by Ultra-NeRF)."""
    angles = points[..., None, :] * torch.exp2(torch.arange(octaves, dtype=points.dtype, device=points.device))[:, None]
    waves = torch.stack([angles.sin(), angles.cos()], dim=-2)  # [..., K, 2, 3]
    return torch.cat([points, waves.flatten(start_dim=-3)], dim=-1)


# SSIM and MS-SSIM as losses, with the windows and constants that each paper uses.


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

    def ms_ssim(self, x: Tensor, y: Tensor) -> Tensor:  # [C, H, W] both -> scalar
        """The mean over the images of MS-SSIM on as many scales as hold a window, their weights adding to 1."""
        x, y = x[:, None], y[:, None]
        count = 1
        while count < len(SCALE_WEIGHTS) and min(x.shape[-2:]) // 2**count >= self.window:
            count += 1
        weights = torch.tensor(SCALE_WEIGHTS[:count], dtype=x.dtype, device=x.device)
        factors = []
        for scale in range(count):
            luminance, contrast = self._maps(x, y)
            coarsest = scale == count - 1
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


# Learning from one training frame a step, all of them an epoch, with a field that a frame is a slice of.


SIMILARITY = Similarity(window=5, is_padded=True)  # of ImplicitVol's loss


def frame_of_step(step: int, frames: int, seed: int) -> int:
    """The training frame of step `step` (from 0): each of `frames` once an epoch, in an order that the epoch decides.

    The order follows from the number of the step alone, so that a fit that goes on after it was killed needs no state.
    """
    epoch, place = divmod(step, frames)
    return int(np.random.default_rng((seed, epoch)).permutation(frames)[place])


class SliceLearner(Learner):
    """A fit of a field whose value at a pixel's place is the pixel: it depends on no direction and on no other pixel.

    `field` gives values [H, W] at points [H, W, 3], whose coordinates are those of the tracker, less `centre_mm`, over
    `half_mm`. The loss is 1 - SSIM of a whole frame. Frames are cut off at 0 and 1 where they are rendered, not where
    they are learned.
    """

    field: Callable[[Tensor], Tensor]

    def __init__(
        self, dataset: Dataset, seed: int, device: torch.device, centre_mm: FloatArray, half_mm: FloatArray
    ) -> None:  # [3], [3]
        super().__init__(dataset, seed, device)
        self.seed, self.centre_mm, self.half_mm = seed, centre_mm, half_mm
        self.pixels_mm = self.pixels_of(dataset.probe, dataset.train.height, dataset.train.width)

    @abstractmethod
    def rates(self, step: int, steps: int) -> dict[str, float]:
        """The optimisers' rates for step `step` (from 0) of `steps`."""

    def set_rates(self, step: int, steps: int) -> None:
        for name, rate in self.rates(step, steps).items():
            for group in self.optimizers[name].param_groups:
                group["lr"] = rate

    def training_points(self, place: int) -> Tensor:  # [H, W, 3]
        """The pixels of a training frame in the field's coordinates."""
        return self.in_field(self.pixels_mm, self.dataset.train.poses[place])

    def rendered_points(self, pixels_mm: Tensor, pose: FloatArray) -> Tensor:  # [H, W, 3] -> [H, W, 3]
        """The pixels of a frame that is asked for at a pose (mm, probe→tracker), in the field's coordinates."""
        return self.in_field(pixels_mm, pose)

    def pixels_of(self, probe: Probe, height: int, width: int) -> Tensor:  # [H, W, 3]
        """The place of each pixel in the probe frame, mm."""
        return as_tensor(pixel_positions_mm(probe, height, width).reshape(height, width, 3), self.device)

    def in_field(self, pixels_mm: Tensor, pose: FloatArray) -> Tensor:  # [H, W, 3] -> [H, W, 3]
        """Points of the probe frame, seen from a pose (mm, probe→tracker), in the field's coordinates."""
        rotation = as_tensor(pose[:3, :3] / self.half_mm[:, None], self.device)
        return pixels_mm @ rotation.T + as_tensor((pose[:3, 3] - self.centre_mm) / self.half_mm, self.device)

    def loss(self, step: int, steps: int) -> Tensor:
        self.set_rates(step, steps)
        place = frame_of_step(step, len(self.images), self.seed)
        frame = self.field(self.training_points(place))
        return 1.0 - SIMILARITY.ssim(frame[None], self.image(place)[None])

    def frame(self, probe: Probe, pose: FloatArray, height: int, width: int) -> Tensor:
        points = self.rendered_points(self.pixels_of(probe, height, width), pose)
        return self.field(points).clamp(0.0, 1.0)


PUBLISHED_FRAMES = 128  # of the example of ImplicitVol's paper; RapidVol is by the same group


class EpochMethod(LearnedMethod):
    """A method whose author counts epochs: one step for each training frame."""

    epochs: int
    learns: Callable[[Dataset, int, torch.device], Learner]

    def published_steps(self, dataset: Dataset) -> int:
        return self.epochs * len(dataset.train)

    def learner(self, dataset: Dataset, budget: Budget, seed: int, device: torch.device) -> Learner:
        return self.learns(dataset, seed, device)
