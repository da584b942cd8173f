"""How well a scene, or any other prediction, meets frames that it has not seen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from .datasets.sweep import IntArray, Sweep
from .errors import DatasetInvalid
from .metrics import FrameMetrics, frame_metrics, mean_metrics, ms_ssim_scales, std_metrics
from .rendering import render
from .scene import GaussianScene

CHUNK_PIXELS = 1 << 22  # rendered at once


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Metrics of F frames. `ms_ssim_scales` is 5 unless the images are too small for all scales of MS-SSIM."""

    frames: list[FrameMetrics]
    frame_numbers: IntArray  # [F] as the sweep numbers them
    ms_ssim_scales: int

    @property
    def mean(self) -> FrameMetrics:
        """Over the frames."""
        return mean_metrics(self.frames)

    @property
    def std(self) -> FrameMetrics:
        """Standard deviation over the frames."""
        return std_metrics(self.frames)

    def to_dict(self) -> dict[str, Any]:
        """A JSON object: `mean`, `std`, `ms_ssim_scales` and the `frames` with their numbers."""
        return {
            "mean": self.mean.to_dict(),
            "std": self.std.to_dict(),
            "ms_ssim_scales": self.ms_ssim_scales,
            "frames": [
                {"frame": int(number), **metrics.to_dict()}
                for number, metrics in zip(self.frame_numbers, self.frames, strict=True)
            ],
        }


def evaluate(scene: GaussianScene, sweep: Sweep, *, backend: str = "auto") -> Evaluation:
    """Renders the scene at the sweep's poses with the sweep's probe and measures against its frames.

    Raises DatasetInvalid where the sweep has no frames, InvalidImageSize below 11x11 pixels, BackendUnavailable.
    """
    return evaluate_frames(render_sweep(scene, sweep, backend=backend), sweep)


def evaluate_frames(frames: npt.NDArray[np.float32], sweep: Sweep) -> Evaluation:  # [F, H, W] in [0, 1]
    """Measures predicted frames against those of the sweep; raises as `evaluate` does."""
    require_frames(sweep)
    truth = torch.from_numpy(sweep.images).float() / 255.0
    return Evaluation(
        frames=frame_metrics(torch.from_numpy(frames), truth),
        frame_numbers=sweep.frame_numbers,
        ms_ssim_scales=ms_ssim_scales(sweep.height, sweep.width),
    )


def require_frames(sweep: Sweep) -> None:
    """Raises DatasetInvalid where there is nothing to measure with."""
    if not len(sweep):
        raise DatasetInvalid(f"{sweep.source}: it holds no frames to measure with; hold some out")


def render_sweep(
    scene: GaussianScene, sweep: Sweep, *, output: str = "bmode", backend: str = "auto"
) -> npt.NDArray[np.float32]:  # [F, H, W]
    """One output of the scene at every pose of the sweep, a few frames at a time."""
    frames = np.zeros(sweep.images.shape, np.float32)
    chunk = max(1, CHUNK_PIXELS // (sweep.height * sweep.width))
    with torch.no_grad():
        for first in range(0, len(sweep), chunk):
            rendered = render(
                scene,
                sweep.probe,
                sweep.poses[first : first + chunk],
                height=sweep.height,
                width=sweep.width,
                outputs=(output,),
                backend=backend,
            )
            frames[first : first + chunk] = getattr(rendered, output).cpu().numpy()
    return frames
