"""Scores of a scene on held-out frames, and whether its expected deviations come true."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from ultragray.errors import DatasetInvalid, InvalidArgument
from ultragray.learn.evaluation.metrics import FrameMetrics, frame_metrics, mean_and_std, ms_ssim_scales
from ultragray.learn.evaluation.speckle import FrameSpeckle, SpeckleSummary, compare_speckle, summarize
from ultragray.learn.sweep import Dataset, IntArray, Sweep
from ultragray.rendering.frames import Frames, render
from ultragray.rendering.outputs import UNCERTAINTY
from ultragray.rendering.speckle import with_speckle
from ultragray.scene.gaussians import GaussianScene
from ultragray.scene.info import SceneInfo

CHUNK_PIXELS = 1 << 20  # rendered and measured at once: measuring takes about 200 bytes of each
CHUNK_FRAMES = 32  # of a frame, rendering takes room for each Gaussian too


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Metrics of F frames. `ms_ssim_scales` is 5 unless the images are too small for all scales of MS-SSIM."""

    frames: list[FrameMetrics]
    frame_numbers: IntArray  # [F] as the sweep numbers them
    ms_ssim_scales: int
    frame_speckle: list[FrameSpeckle]
    frame_natural: list[FrameSpeckle] = field(default_factory=list)  # with natural speckle; of scenes that know it

    @property
    def mean(self) -> FrameMetrics:
        return mean_and_std(self.frames)[0]

    @property
    def std(self) -> FrameMetrics:
        return mean_and_std(self.frames)[1]

    @property
    def speckle(self) -> SpeckleSummary:
        return summarize(self.frame_speckle)

    @property
    def natural(self) -> SpeckleSummary | None:
        """The speckle of frames with natural speckle, which metrics do not see; None where the scene knows none."""
        return summarize(self.frame_natural) if self.frame_natural else None

    def to_dict(self) -> dict[str, Any]:
        """A JSON object: `mean`, `std`, `ms_ssim_scales`, `speckle`, `natural` where it is known, and the
        `frames` with their numbers."""
        return {
            "mean": self.mean.to_dict(),
            "std": self.std.to_dict(),
            "ms_ssim_scales": self.ms_ssim_scales,
            "speckle": self.speckle.to_dict(),
            **({"natural": self.natural.to_dict()} if self.natural else {}),
            "frames": [
                {"frame": int(number), **metrics.to_dict()}
                for number, metrics in zip(self.frame_numbers, self.frames, strict=True)
            ],
        }


def evaluate(
    scene: GaussianScene,
    sweep: Sweep,
    *,
    backend: str = "auto",
    after_portion: Callable[[int], object] = lambda done: None,
) -> Evaluation:
    """Renders the scene at the sweep's poses with the sweep's probe and measures against its frames, a few at a time.

    `after_portion` is told how many frames are done; to stop, it raises.

    Raises DatasetInvalid where the sweep has no frames, InvalidImageSize below 11x11 pixels, BackendUnavailable.
    """
    natural: list[FrameSpeckle] = []

    def predictions() -> Iterator[npt.NDArray[np.float32]]:
        for some, frames in rendered_parts(scene, sweep, ("bmode",), backend):
            bmode = frames["bmode"].float().cpu()
            if scene.info.speckle is not None:
                images = with_speckle(scene, bmode, some.probe, scene.poses_at_rest(some.poses), backend=backend)
                natural.extend(compare_speckle(images.numpy(), some.images.astype(np.float32) / 255.0, some.probe))
            yield bmode.numpy()

    return replace(_measured(predictions(), sweep, after_portion), frame_natural=natural)


def evaluate_frames(frames: npt.NDArray[np.float32], sweep: Sweep) -> Evaluation:  # [F, H, W] in [0, 1]
    """Measures predicted frames against those of the sweep; raises as `evaluate` does."""
    if frames.shape != sweep.images.shape:
        raise InvalidArgument(
            f"frames must be {list(sweep.images.shape)} like those of {sweep.source}, got {list(frames.shape)}",
            field="frames",
        )
    return _measured((frames[places] for places in _chunks(sweep)), sweep)


def _measured(
    predictions: Iterable[npt.NDArray[np.float32]],
    sweep: Sweep,
    after_portion: Callable[[int], object] = lambda done: None,
) -> Evaluation:
    require_frames(sweep)
    scales = ms_ssim_scales(sweep.height, sweep.width)
    measured: list[FrameMetrics] = []
    speckle: list[FrameSpeckle] = []
    for predicted, places in zip(predictions, _chunks(sweep), strict=True):
        truth = torch.from_numpy(sweep.images[places]).float().div_(255.0)
        measured += frame_metrics(torch.from_numpy(predicted), truth)
        speckle += compare_speckle(predicted, truth.numpy(), sweep.probe)
        after_portion(len(measured))
    return Evaluation(measured, sweep.frame_numbers, scales, speckle)


def frames_at_once(height: int, width: int) -> int:
    return min(CHUNK_FRAMES, max(1, CHUNK_PIXELS // (height * width)))


def _chunks(sweep: Sweep) -> Iterator[slice]:
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


def rendered_parts(
    scene: GaussianScene, sweep: Sweep, outputs: Sequence[str], backend: str
) -> Iterator[tuple[Sweep, Frames]]:
    """A few frames of the sweep at a time, and the outputs of the scene at their poses."""
    for places in _chunks(sweep):
        some = sweep.select(np.arange(len(sweep))[places])
        with torch.no_grad():
            frames = render(
                scene, some.probe, some.poses, height=some.height, width=some.width, outputs=outputs, backend=backend
            )
        yield some, frames


def render_sweep(
    scene: GaussianScene, sweep: Sweep, *, output: str = "bmode", backend: str = "auto"
) -> npt.NDArray[np.float32]:  # [F, H, W]
    """One output of the scene at every pose of the sweep, a few frames at a time."""
    whole = np.zeros(sweep.images.shape, np.float32)
    parts = rendered_parts(scene, sweep, (output,), backend)
    for places, (_, frames) in zip(_chunks(sweep), parts, strict=True):
        whole[places] = frames[output].cpu().numpy()
    return whole


BINS = np.array([0.0, 0.01, 0.02, 0.03, 0.045, 0.065, 0.09, 0.12, 0.16, 0.22, 0.3, 1.0])  # of the expected deviation
LEAST_SHARE = 0.001  # of all pixels: bins with fewer are left out, their figures would be chance


@dataclass(frozen=True)
class Bin:
    """Pixels whose expected deviations are alike."""

    share: float  # of all pixels
    expected: float  # root of the mean variance
    actual: float  # root of the mean squared error


@dataclass(frozen=True)
class Reliability:
    """Expected and actual deviation over all pixels, shares of errors within 1 and 2 of their own, and the bins."""

    expected: float
    actual: float
    within_1: float  # 0.68 where errors are normal
    within_2: float  # 0.95 likewise
    bins: tuple[Bin, ...]

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    def figures(self) -> dict[str, float]:
        named = {"expected": self.expected, "actual": self.actual, "within_1": self.within_1, "within_2": self.within_2}
        return {f"uncertainty_{name}": value for name, value in named.items()}


def measure_reliability(scene: GaussianScene, sweep: Sweep, *, backend: str = "auto") -> Reliability | None:
    """Renders the scene at the sweep's poses and compares. None where the scene lacks the output.

    Raises DatasetInvalid where the sweep has no frames, BackendUnavailable.
    """
    require_frames(sweep)
    if UNCERTAINTY.lacks(scene.info) is not None:
        return None
    tallies = []
    for some, frames in rendered_parts(scene, sweep, ("bmode", "uncertainty"), backend):
        bmode, deviation = (frames[name].cpu().numpy() for name in ("bmode", "uncertainty"))
        tallies.append(_tally(some.images / np.float32(255.0) - bmode, deviation))
    return _of_tally(np.sum(tallies, axis=0))


def compare_deviations(errors: npt.NDArray[np.float32], deviations: npt.NDArray[np.float32]) -> Reliability:
    """Of errors of pixels and the deviations that were expected of them, of any one shape."""
    return _of_tally(_tally(errors, deviations))


def _tally(errors: npt.NDArray[np.float32], deviations: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """[5, bins]: pixels, summed variances, summed squared errors, errors within 1 and within 2 deviations."""
    sizes, expected = np.abs(errors).ravel(), deviations.ravel()
    places = np.clip(np.searchsorted(BINS, expected, side="right") - 1, 0, len(BINS) - 2)
    weights: Sequence[npt.NDArray[Any] | None] = (
        None,
        expected.astype(np.float64) ** 2,
        sizes.astype(np.float64) ** 2,
        sizes <= expected,
        sizes <= 2.0 * expected,
    )
    return np.stack([np.bincount(places, some, len(BINS) - 1) for some in weights]).astype(np.float64)


def _of_tally(tally: npt.NDArray[np.float64]) -> Reliability:
    count, *sums = tally.sum(axis=1)
    variance, squared, within_1, within_2 = (float(value) for value in np.array(sums) / count)
    kept = tally[:, tally[0] >= LEAST_SHARE * count]
    bins = [
        Bin(float(pixels / count), float((variances / pixels) ** 0.5), float((squares / pixels) ** 0.5))
        for pixels, variances, squares, *_ in kept.T
    ]
    return Reliability(variance**0.5, squared**0.5, within_1, within_2, tuple(bins))
