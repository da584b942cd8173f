"""The reliability of the output `uncertainty`: expected against actual errors of pixels, on held-out frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from ultragray.datasets.sweep import Sweep
from ultragray.evaluation.scoring import frames_at_once, require_frames
from ultragray.outputs import UNCERTAINTY
from ultragray.rendering import render
from ultragray.scene import GaussianScene

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
        """A JSON object."""
        return asdict(self)

    def figures(self) -> dict[str, float]:
        """The numbers over all pixels, by name."""
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
    portion = frames_at_once(sweep.height, sweep.width)
    with torch.no_grad():
        for first in range(0, len(sweep), portion):
            some = sweep.select(np.arange(first, min(first + portion, len(sweep))))
            frames = render(
                scene,
                some.probe,
                some.poses,
                height=some.height,
                width=some.width,
                outputs=("bmode", "uncertainty"),
                backend=backend,
            )
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
