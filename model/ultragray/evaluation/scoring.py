"""Scores of a scene, or of any other prediction, on frames that it has not seen."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from ultragray.datasets.sweep import Dataset, IntArray, Sweep
from ultragray.errors import DatasetInvalid, InvalidArgument
from ultragray.evaluation.metrics import FrameMetrics, frame_metrics, mean_metrics, ms_ssim_scales, std_metrics
from ultragray.evaluation.speckle import FrameSpeckle, SpeckleSummary, compare_speckle, summarize
from ultragray.rendering import render
from ultragray.scene import GaussianScene
from ultragray.scene_info import SceneInfo

CHUNK_PIXELS = 1 << 20  # rendered and measured at once: measuring takes about 200 bytes of each
CHUNK_FRAMES = 32  # of a frame, rendering takes room for each Gaussian too


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Metrics of F frames. `ms_ssim_scales` is 5 unless the images are too small for all scales of MS-SSIM."""

    frames: list[FrameMetrics]
    frame_numbers: IntArray  # [F] as the sweep numbers them
    ms_ssim_scales: int
    frame_speckle: list[FrameSpeckle]

    @property
    def mean(self) -> FrameMetrics:
        """Over the frames."""
        return mean_metrics(self.frames)

    @property
    def std(self) -> FrameMetrics:
        """Standard deviation over the frames."""
        return std_metrics(self.frames)

    @property
    def speckle(self) -> SpeckleSummary:
        """Means over the frames."""
        return summarize(self.frame_speckle)

    def to_dict(self) -> dict[str, Any]:
        """A JSON object: `mean`, `std`, `ms_ssim_scales`, `speckle` and the `frames` with their numbers."""
        return {
            "mean": self.mean.to_dict(),
            "std": self.std.to_dict(),
            "ms_ssim_scales": self.ms_ssim_scales,
            "speckle": self.speckle.to_dict(),
            "frames": [
                {"frame": int(number), **metrics.to_dict()}
                for number, metrics in zip(self.frame_numbers, self.frames, strict=True)
            ],
        }


def evaluate(scene: GaussianScene, sweep: Sweep, *, backend: str = "auto") -> Evaluation:
    """Renders the scene at the sweep's poses with the sweep's probe and measures against its frames, a few at a time.

    Raises DatasetInvalid where the sweep has no frames, InvalidImageSize below 11x11 pixels, BackendUnavailable.
    """
    parts = (sweep.select(np.arange(len(sweep))[places]) for places in _chunks(sweep))
    return _measured((render_sweep(scene, part, backend=backend) for part in parts), sweep)


def evaluate_frames(frames: npt.NDArray[np.float32], sweep: Sweep) -> Evaluation:  # [F, H, W] in [0, 1]
    """Measures predicted frames against those of the sweep; raises as `evaluate` does."""
    if frames.shape != sweep.images.shape:
        raise InvalidArgument(
            f"frames must be {list(sweep.images.shape)} like those of {sweep.source}, got {list(frames.shape)}",
            field="frames",
        )
    return _measured((frames[places] for places in _chunks(sweep)), sweep)


def _measured(predictions: Iterable[npt.NDArray[np.float32]], sweep: Sweep) -> Evaluation:
    """Measures the predicted frames of each of `_chunks`."""
    require_frames(sweep)
    scales = ms_ssim_scales(sweep.height, sweep.width)
    measured: list[FrameMetrics] = []
    speckle: list[FrameSpeckle] = []
    for predicted, places in zip(predictions, _chunks(sweep), strict=True):
        truth = torch.from_numpy(sweep.images[places]).float().div_(255.0)
        measured += frame_metrics(torch.from_numpy(predicted), truth)
        speckle += compare_speckle(predicted, truth.numpy(), sweep.probe)
    return Evaluation(measured, sweep.frame_numbers, scales, speckle)


def frames_at_once(height: int, width: int) -> int:
    """The number of frames of this size that are rendered and measured together."""
    return min(CHUNK_FRAMES, max(1, CHUNK_PIXELS // (height * width)))


def _chunks(sweep: Sweep) -> Iterator[slice]:
    """Places of the frames that are taken at once, in order."""
    count = frames_at_once(sweep.height, sweep.width)
    for first in range(0, len(sweep), count):
        yield slice(first, first + count)


def require_frames(sweep: Sweep) -> None:
    """Raises DatasetInvalid where there is nothing to measure with."""
    if not len(sweep):
        raise DatasetInvalid(f"{sweep.source}: it holds no frames to measure with; hold some out")


def check_same_origin(info: SceneInfo, dataset: Dataset) -> list[str]:
    """Warnings where a scene was trained with another probe or from other data, as far as its `info` says.

    Raises DatasetInvalid where the probes are of different kinds: their frames cannot be compared.
    """
    warnings = []
    if info.probe is not None and info.probe.kind != dataset.probe.kind:
        raise DatasetInvalid(
            f"{dataset.name}: its probe is {dataset.probe.kind}, the scene was trained with a {info.probe.kind} one"
        )
    if info.probe not in (None, dataset.probe):
        warnings.append(f"the scene was trained with a {info.probe}, {dataset.name} has a {dataset.probe}")
    if info.dataset_sha256 not in (None, dataset.sha256):
        warnings.append(
            f"the scene was trained from other data than {dataset.name}, or from another split of it: it may have "
            "been trained on the frames it is measured on"
        )
    return warnings


def render_sweep(
    scene: GaussianScene, sweep: Sweep, *, output: str = "bmode", backend: str = "auto"
) -> npt.NDArray[np.float32]:  # [F, H, W]
    """One output of the scene at every pose of the sweep, a few frames at a time."""
    frames = np.zeros(sweep.images.shape, np.float32)
    with torch.no_grad():
        for places in _chunks(sweep):
            rendered = render(
                scene,
                sweep.probe,
                sweep.poses[places],
                height=sweep.height,
                width=sweep.width,
                outputs=(output,),
                backend=backend,
            )
            frames[places] = getattr(rendered, output).cpu().numpy()
    return frames
