"""The truth of confidence and uncertainty: what scenes tell of frames that they have not seen, against what comes out.

    python benchmarks/confidence.py [--only NAME ...] [--data FOLDER]

Each scene is trained from in-silico sweeps that leave something out, or with --data from sets of that folder; it is
then asked for what was left out, cause by cause. Each scene's figures go into build/bench/confidence.json as soon as
they are known; the tables of docs/confidence.md come from it, and the pictures that `draw` makes.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from in_silico import IN_SILICO, Asked
from registry import FIGURES, ROOT, Document
from ultragray.datasets.source import load_dataset
from ultragray.files import write_whole
from ultragray.geometry.probe import FloatArray
from ultragray.learn.evaluation.metrics import frame_metrics
from ultragray.learn.evaluation.scoring import compare_deviations, render_sweep
from ultragray.learn.sweep import Dataset
from ultragray.learn.training import TrainingConfig, train
from ultragray.scene.confidence import Assessor
from ultragray_studies.bench.report import measured

OUTPUT = FIGURES["confidence"].staged
IMAGES = ROOT / "docs" / "images"
ERROR, RANK = 0.07, 0.8  # that are aimed at
TELLING_STD = 0.05  # of actual values; where they vary less, ranks mean little
COLOURS = {
    "tilt": "#0b6e99",
    "steep": "#7c3aed",
    "gap": "#d97706",
    "end": "#6d8f3c",
    "band": "#c2410c",
    "random": "#475569",
}


def recorded(folder: Path, name: str) -> Asked:
    """A recorded set: its held-out frames, and where it has more than 40 training frames a band and an end of these."""
    dataset = load_dataset(folder / name)
    train, count = dataset.train, len(dataset.train)
    if count <= 40:
        return Asked(train, dataset.val, np.array(["random"] * len(dataset.val)))
    numbers = np.arange(count)
    gap = (numbers >= 0.4 * count) & (numbers < 0.5 * count)
    end = numbers >= 0.9 * count
    random = (numbers % 7 == 3) & ~gap & ~end
    left_out = gap | end | random
    causes = np.where(gap, "gap", np.where(end, "end", "random"))[left_out]
    return Asked(train.select(numbers[~left_out]), train.select(numbers[left_out]), causes)


RECORDED = ("spine_phantom", "liver_convex", "ultranerf_liver", "nwire_phantom")


def measure(asked: Asked, config: TrainingConfig) -> dict[str, Any]:
    """Trains a scene, renders what it has not seen and measures each frame and its pixels."""
    head, started = measured(torch.get_num_threads()), time.monotonic()
    unseen, causes = asked.unseen, asked.causes
    scene = train(Dataset("asked", asked.training, unseen.select([])), config)
    seconds = time.monotonic() - started
    frames = {name: render_sweep(scene, unseen, output=name) for name in ("bmode", "coverage", "uncertainty")}
    truth = (unseen.images / 255.0).astype(np.float32)
    metrics = frame_metrics(torch.from_numpy(frames["bmode"]), torch.from_numpy(truth))
    assessor = Assessor(scene.info, scene.training_poses)
    told = assessor.assess(unseen.poses, coverage=frames["coverage"])
    of_poses = assessor.assess(unseen.poses)
    errors = truth - frames["bmode"]
    figures: dict[str, Any] = {
        "measured": head,
        "training_frames": len(asked.training),
        "seconds": round(seconds, 1),
        "causes": {},
    }
    for cause in dict.fromkeys(causes.tolist()):
        chosen = causes == cause
        figures["causes"][cause] = {
            "actual": [round(frame.ms_ssim, 4) for frame, one in zip(metrics, chosen, strict=True) if one],
            "told": _rounded([one.confidence for one, is_one in zip(told, chosen, strict=True) if is_one]),
            "of_pose": _rounded([one.confidence for one, is_one in zip(of_poses, chosen, strict=True) if is_one]),
            "supported_share": _rounded([o.supported_share for o, is_one in zip(told, chosen, strict=True) if is_one]),
            "uncertainty": asdict(compare_deviations(errors[chosen], frames["uncertainty"][chosen])),
        }
    return figures


def tables(figures: Document) -> Iterator[str]:
    """The Markdown of what was measured."""
    figures = _ordered(figures)
    yield "| scene | frames | cause | actual | of the frame | of the pose alone |"
    yield "|---|---|---|---|---|---|"
    for name, cause, found in _cells(figures):
        actual = np.array(found["actual"])
        agreements = [_agreement(np.array(found[key]), actual) for key in ("told", "of_pose")]
        spread = f"{actual.mean():.2f} ± {actual.std():.2f}"
        count = figures[name]["training_frames"]
        yield f"| {name} | {count} | {cause} ({len(actual)}) | {spread} | {' | '.join(agreements)} |"
    yield ""
    cells = list(_cells(figures))
    telling = sum(np.std(found["actual"]) > TELLING_STD for _, _, found in cells)
    for key, of_what in (("told", "Of rendered frames"), ("of_pose", "Of poses alone")):
        errors = [f"{cause} of {name}" for name, cause, found in cells if _error(found, key) > ERROR]
        ranks = [f"{cause} of {name}" for name, cause, found in cells if _rank(found, key) < RANK]
        yield f"{of_what}, {len(errors)} of {len(cells)} errors are above {ERROR:g}: {_listed(errors)}."
        yield f"{len(ranks)} of {telling} rank correlations are below {RANK:g}: {_listed(ranks)}."
        yield ""
    yield "| scene | cause | expected | actual | within 1σ | within 2σ |"
    yield "|---|---|---|---|---|---|"
    for name, cause, found in _cells(figures):
        pixels = found["uncertainty"]
        numbers = [f"{pixels[key]:.3f}" for key in ("expected", "actual")]
        shares = [f"{pixels[key]:.0%}" for key in ("within_1", "within_2")]
        yield f"| {name} | {cause} | {' | '.join(numbers + shares)} |"


def _ordered(figures: Document) -> Document:
    return {name: figures[name] for name in (*IN_SILICO, *RECORDED) if name in figures}


def _error(found: dict[str, Any], key: str) -> float:
    return float(np.abs(np.array(found[key]) - np.array(found["actual"])).mean())


def _rank(found: dict[str, Any], key: str) -> float:
    """1 where ranks mean little."""
    told, actual = np.array(found[key]), np.array(found["actual"])
    return rank_correlation(told, actual) if actual.std() > TELLING_STD else 1.0


def _listed(names: list[str]) -> str:
    return ", ".join(names) or "none"


def _agreement(told: FloatArray, actual: FloatArray) -> str:
    error = f"{np.abs(told - actual).mean():.3f}"
    return f"{error} / {rank_correlation(told, actual):.2f}" if actual.std() > TELLING_STD else f"{error} / –"


def rank_correlation(first: FloatArray, second: FloatArray) -> float:
    """Spearman's; no two values are equal."""
    ranks = [values.argsort().argsort() for values in (first, second)]
    return float(np.corrcoef(*ranks)[0, 1])


def draw(figures: Document) -> None:
    """The two pictures of docs/confidence.md."""
    figures = _ordered(figures)
    names = list(figures)
    rows, columns = -(-len(names) // 3), min(3, len(names))
    for key, picture in (("told", "confidence_reliability.png"), ("uncertainty", "uncertainty_reliability.png")):
        figure = Figure(figsize=(3.6 * columns, 3.4 * rows), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False).ravel()
        for axis, name in zip(axes, names, strict=False):
            most = 1.0 if key == "told" else 0.45
            axis.plot([0, most], [0, most], color="#9aa5b1", linewidth=1.0)
            for cause, found in figures[name]["causes"].items():
                if key == "told":
                    axis.plot(found["told"], found["actual"], ".", color=COLOURS[cause], label=cause, alpha=0.7)
                else:
                    bins = found["uncertainty"]["bins"]
                    expected, actual = ([one[side] for one in bins] for side in ("expected", "actual"))
                    axis.plot(expected, actual, ".-", color=COLOURS[cause], label=cause)
            axis.set(xlim=(0, most), ylim=(0, most), title=name, aspect="equal")
            axis.set(xlabel="confidence" if key == "told" else "expected deviation")
            axis.set(ylabel="actual MS-SSIM" if key == "told" else "actual deviation")
            axis.spines[["top", "right"]].set_visible(False)
            axis.legend(frameon=False, fontsize="small")
        for axis in axes[len(names) :]:
            axis.set_visible(False)
        FigureCanvasAgg(figure)
        figure.savefig(IMAGES / picture, dpi=70)


def _cells(figures: dict[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    for name, one in figures.items():
        for cause, found in one["causes"].items():
            yield name, cause, found


def _rounded(values: list[float | None]) -> list[float]:
    return [round(float(value), 4) for value in values if value is not None]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=[*IN_SILICO, *RECORDED], help="leave out the others")
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="of the recorded sets; without, they are left out")
    given = parser.parse_args()
    torch.set_num_threads(1)
    config = TrainingConfig.preset("fast")
    runs = dict(IN_SILICO)
    if given.data is not None:
        runs |= {name: partial(recorded, given.data, name) for name in RECORDED}
    OUTPUT.parent.mkdir(parents=True, exist_ok=True)
    known = json.loads(OUTPUT.read_text()) if OUTPUT.exists() else {}
    for name, ask in runs.items():
        if given.only is None or name in given.only:
            known[name] = measure(ask(), config)
            sys.stderr.write(f"{name}: {known[name]['seconds']:.0f} s\n")
            write_whole(OUTPUT, json.dumps(known, indent=1, allow_nan=False) + "\n")


if __name__ == "__main__":
    main()
