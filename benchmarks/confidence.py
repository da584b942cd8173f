"""The truth of a scene's confidence: in-silico sweeps that mix causes, predicted against actual MS-SSIM.

    python benchmarks/confidence.py [--only NAME ...]
    python benchmarks/confidence.py --recorded FOLDER

Each scene is trained from sweeps with gaps, at some tilts, that stop short of one end; it is then asked for frames of
new sweeps: tilted by −10° … 10°, within the gaps, and off the end. Writes docs/images/confidence_reliability.png and
prints the table of docs/confidence.md. With --recorded it trains from a data set and tells of its
held-out frames.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ultragray.confidence import Assessor
from ultragray.datasets.phantom import PHANTOM_PROBE, freehand_poses, simulate
from ultragray.datasets.source import load_dataset
from ultragray.datasets.sweep import Dataset, Sweep
from ultragray.evaluation.scoring import evaluate
from ultragray.probe import FloatArray
from ultragray.training import TrainingConfig, train

PICTURE = Path(__file__).parents[1] / "docs" / "images" / "confidence_reliability.png"
COLOURS = {"tilt": "#0b6e99", "gap": "#d97706", "end": "#6d8f3c"}
TILTS_DEG = np.linspace(-10.0, 10.0, 9)
FIRST_MM = -36.0  # where the sweeps begin


@dataclass(frozen=True)
class Mixture:
    """A training set: sweeps of `count` frames at `tilts`, without `gaps` and what lies beyond `end_mm`."""

    seed: int
    tilts: tuple[float, ...]
    count: int
    gaps: tuple[tuple[float, float], ...]
    end_mm: float
    over_mm: float = 10.0  # how far beyond frames are asked for
    first_mm: float = FIRST_MM
    side: int = 128

    def poses(self) -> tuple[FloatArray, FloatArray, np.ndarray]:  # [F, 4, 4], [C, 4, 4], [C]
        """Training poses, poses to ask for, and the cause that each of those is there for."""
        generator = np.random.default_rng(self.seed)

        def sweep(count: int, tilt_deg: float) -> FloatArray:
            offset_mm, unrest = generator.uniform(-2.0, 2.0), generator.uniform(0.0, 6.0)
            return freehand_poses(count, tilt_deg=tilt_deg, offset_mm=offset_mm, unrest=unrest)

        trained, asked, causes = [], [], []
        for tilt in self.tilts:
            poses = sweep(self.count, tilt)
            trained.append(poses[self._is_trained(poses)])
        for tilt in TILTS_DEG:
            poses = sweep(300, float(tilt))
            asked.append(poses[generator.choice(np.flatnonzero(self._is_trained(poses)), 5, replace=False)])
            causes += ["tilt"] * 5
        for cause, sweeps in (("gap", 6), ("end", 5)):
            for _ in range(sweeps):
                poses = sweep(600, float(generator.choice(self.tilts)))
                along = poses[:, 1, 3]
                beyond = (along > self.end_mm) & (along < self.end_mm + self.over_mm)
                chosen = self._in_gap(along) if cause == "gap" else beyond
                asked.append(poses[generator.choice(np.flatnonzero(chosen), 6, replace=False)])
                causes += [cause] * 6
        return np.concatenate(trained), np.concatenate(asked), np.array(causes)

    def _is_trained(self, poses: FloatArray) -> np.ndarray:
        along = poses[:, 1, 3]
        return (along >= self.first_mm) & (along <= self.end_mm) & ~self._in_gap(along)

    def _in_gap(self, along: FloatArray) -> np.ndarray:
        return np.any([(along > low) & (along < high) for low, high in self.gaps], axis=0)


MIXTURES = {
    "two tilts": Mixture(101, (-3.0, 3.0), 41, ((-22.0, -15.0), (2.0, 7.0)), 22.0, over_mm=12.0),
    "one sweep": Mixture(102, (0.0,), 46, ((-26.0, -20.0), (-8.0, -4.0), (10.0, 15.0)), 27.0),
    "three tilts": Mixture(103, (-6.0, 0.0, 6.0), 30, ((-10.0, -2.0), (6.0, 10.0)), 18.0, first_mm=-30.0),
    "one side": Mixture(104, (0.0, 4.0), 36, ((-28.0, -24.0), (-16.0, -9.0), (4.0, 7.0)), 25.0, side=160),
}


def measure(mixture: Mixture) -> tuple[FloatArray, FloatArray, np.ndarray, int]:
    """Predicted and actual MS-SSIM of the frames asked for, their causes, and the number of training frames."""
    trained, asked, causes = mixture.poses()
    poses = np.concatenate([trained, asked])
    images = simulate(poses, probe=PHANTOM_PROBE, height=mixture.side, width=mixture.side)
    sweep = Sweep(images, poses, PHANTOM_PROBE, np.arange(len(poses)), "phantom")
    training, unseen = sweep.select(np.arange(len(trained))), sweep.select(np.arange(len(trained), len(poses)))
    scene = train(Dataset("phantom", training, unseen.select([])), TrainingConfig.preset("fast"))
    actual = np.array([frame.ms_ssim for frame in evaluate(scene, unseen).frames])
    told = Assessor(scene.info, scene.training_poses).assess(unseen.poses)
    return np.array([frame.confidence for frame in told], dtype=np.float64), actual, causes, len(training)


def tell_recorded(dataset: Dataset) -> str:
    """The confidence of held-out frames against their MS-SSIM, in words."""
    scene = train(dataset, TrainingConfig.preset("fast"))
    actual = np.array([frame.ms_ssim for frame in evaluate(scene, dataset.val).frames])
    told = Assessor(scene.info, scene.training_poses).assess(dataset.val.poses)
    predicted = np.array([frame.confidence for frame in told], dtype=np.float64)
    return (
        f"{dataset.name}: {len(dataset.train)} training frames, {len(actual)} held out: "
        f"confidence {predicted.mean():.3f}, actual {actual.mean():.3f}, "
        f"mean absolute error {np.abs(predicted - actual).mean():.3f}"
    )


def rank_correlation(first: FloatArray, second: FloatArray) -> float:
    """Spearman's; no two values are equal."""
    ranks = [values.argsort().argsort() for values in (first, second)]
    return float(np.corrcoef(*ranks)[0, 1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", choices=list(MIXTURES), default=list(MIXTURES))
    parser.add_argument("--recorded", metavar="FOLDER", help="of a data set, instead of the in-silico scenes")
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.recorded is not None:
        sys.stdout.write(tell_recorded(load_dataset(given.recorded)) + "\n")
        return
    names = given.only
    figure = Figure(figsize=(4.2 * min(2, len(names)), 4.0 * -(-len(names) // 2)), layout="constrained")
    axes = figure.subplots(-(-len(names) // 2), min(2, len(names)), squeeze=False).ravel()
    out = sys.stdout
    out.write("| scene | frames | all | tilt | gap | end |\n|---|---|---|---|---|---|\n")
    for axis, name in zip(axes, names, strict=False):
        started = time.monotonic()
        predicted, actual, causes, count = measure(MIXTURES[name])
        cells = []
        for chosen in (np.ones(len(causes), bool), *(causes == cause for cause in COLOURS)):
            error = np.abs(predicted - actual)[chosen].mean()
            cells.append(
                f"{error:.3f} / {rank_correlation(predicted[chosen], actual[chosen]):.2f} ({actual[chosen].std():.2f})"
            )
        out.write(f"| {name} | {count} | {' | '.join(cells)} |\n")
        sys.stderr.write(f"{name}: {time.monotonic() - started:.0f} s\n")
        axis.plot([0, 1], [0, 1], color="#9aa5b1", linewidth=1.0)
        for cause, colour in COLOURS.items():
            axis.plot(predicted[causes == cause], actual[causes == cause], ".", color=colour, label=cause, alpha=0.7)
        axis.set(xlabel="confidence", ylabel="actual MS-SSIM", xlim=(0, 1), ylim=(0, 1), title=name, aspect="equal")
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].legend(frameon=False)
    for axis in axes[len(names) :]:
        axis.set_visible(False)
    FigureCanvasAgg(figure)
    figure.savefig(PICTURE, dpi=80)


if __name__ == "__main__":
    main()
