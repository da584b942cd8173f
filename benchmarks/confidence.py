"""The truth of confidence and uncertainty: what scenes tell of frames that they have not seen, against what comes out.

Each scene is trained from in-silico or recorded sweeps that leave something out; it is then asked for what was left
out, cause by cause: `make confidence`. The pictures of docs/confidence.md come from `draw`.
"""

from __future__ import annotations

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

from in_silico import IN_SILICO, Case
from measuring import ROOT, Document, Lines, columns, measure_runs, table
from ultragray.datasets.source import load_dataset
from ultragray.learn.evaluation.metrics import frame_metrics
from ultragray.learn.evaluation.scoring import compare_deviations, render_sweep
from ultragray.learn.sweep import Dataset
from ultragray.learn.training import TrainingConfig, train
from ultragray.scene.confidence import Assessor

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


def recorded(folder: Path, name: str) -> Case:
    """A recorded set: its held-out frames, and where it has more than 40 training frames a band and an end of these."""
    dataset = load_dataset(folder / name)
    train, count = dataset.train, len(dataset.train)
    if count <= 40:
        return Case(train, dataset.val, np.array(["random"] * len(dataset.val)))
    numbers = np.arange(count)
    gap = (numbers >= 0.4 * count) & (numbers < 0.5 * count)
    end = numbers >= 0.9 * count
    random = (numbers % 7 == 3) & ~gap & ~end
    left_out = gap | end | random
    causes = np.where(gap, "gap", np.where(end, "end", "random"))[left_out]
    return Case(train.select(numbers[~left_out]), train.select(numbers[left_out]), causes)


RECORDED = ("spine_phantom", "liver_convex", "ultranerf_liver", "nwire_phantom")


def measure(name: str, data_folder: Path) -> Document:
    """Trains a scene, renders what it has not seen and measures each frame and its pixels."""
    case = IN_SILICO[name]() if name in IN_SILICO else recorded(data_folder, name)
    started = time.monotonic()
    unseen, causes = case.unseen, case.causes
    scene = train(Dataset("asked", case.training, unseen.select([])), TrainingConfig.preset("fast"))
    seconds = time.monotonic() - started
    frames = {name: render_sweep(scene, unseen, output=name) for name in ("bmode", "coverage", "uncertainty")}
    truth = (unseen.images / 255.0).astype(np.float32)
    metrics = frame_metrics(torch.from_numpy(frames["bmode"]), torch.from_numpy(truth))
    assessor = Assessor(scene.info, scene.training_poses)
    of_frames = assessor.assess(unseen.poses, coverage=frames["coverage"])
    of_poses = assessor.assess(unseen.poses)
    errors = truth - frames["bmode"]
    figures: dict[str, Any] = {
        "training_frames": len(case.training),
        "seconds": round(seconds, 1),
        "causes": {},
    }
    for cause in dict.fromkeys(causes.tolist()):
        chosen = causes == cause
        figures["causes"][cause] = {
            "actual": [round(frame.ms_ssim, 4) for frame, one in zip(metrics, chosen, strict=True) if one],
            "told": _rounded([one.confidence for one, is_one in zip(of_frames, chosen, strict=True) if is_one]),
            "of_pose": _rounded([one.confidence for one, is_one in zip(of_poses, chosen, strict=True) if is_one]),
            "supported_share": _rounded(
                [o.supported_share for o, is_one in zip(of_frames, chosen, strict=True) if is_one]
            ),
            "uncertainty": asdict(compare_deviations(errors[chosen], frames["uncertainty"][chosen])),
        }
    return figures


def error(figures: Document, key: str) -> float:
    """The mean error of what was told, or told of the pose alone."""
    return float(np.abs(np.array(figures[key]) - np.array(figures["actual"])).mean())


def is_telling(figures: Document) -> bool:
    """Whether actual values vary enough for ranks to mean something."""
    return bool(np.std(figures["actual"]) > TELLING_STD)


def rank_correlation(figures: Document, key: str) -> float:
    """Spearman's, of what was told and what came out; no two values are equal."""
    ranks = [np.array(values).argsort().argsort() for values in (figures[key], figures["actual"])]
    return float(np.corrcoef(*ranks)[0, 1])


def cells(figures: Document) -> Iterator[tuple[str, str, Document]]:
    """Scene, cause and figures, in the order of the tables."""
    for name in (*IN_SILICO, *RECORDED):
        for cause, of_cause in figures.get(name, {"causes": {}})["causes"].items():
            yield name, cause, of_cause


def draw(figures: Document) -> None:
    """The two pictures of docs/confidence.md."""
    names = [name for name in (*IN_SILICO, *RECORDED) if name in figures]
    rows, columns = -(-len(names) // 3), min(3, len(names))
    for key, picture in (("told", "confidence_reliability.png"), ("uncertainty", "uncertainty_reliability.png")):
        figure = Figure(figsize=(3.6 * columns, 3.4 * rows), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False).ravel()
        for axis, name in zip(axes, names, strict=False):
            most = 1.0 if key == "told" else 0.45
            axis.plot([0, most], [0, most], color="#9aa5b1", linewidth=1.0)
            for cause, of_cause in figures[name]["causes"].items():
                if key == "told":
                    axis.plot(of_cause["told"], of_cause["actual"], ".", color=COLOURS[cause], label=cause, alpha=0.7)
                else:
                    bins = of_cause["uncertainty"]["bins"]
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


def _rounded(values: list[float | None]) -> list[float]:
    return [round(float(value), 4) for value in values if value is not None]


def confidence_and_uncertainty(figures: Document) -> Lines:
    """What scenes tell of frames that they have not seen, beside what came out, cause by cause."""
    all_cells = list(cells(figures))
    rows = []
    for name, cause, of_cause in all_cells:
        actual = np.array(of_cause["actual"])
        agreements = []
        for key in ("told", "of_pose"):
            rank = f"{rank_correlation(of_cause, key):.2f}" if is_telling(of_cause) else "–"
            agreements.append(f"{error(of_cause, key):.3f} / {rank}")
        spread = f"{actual.mean():.2f} ± {actual.std():.2f}"
        rows.append((name, str(figures[name]["training_frames"]), f"{cause} ({len(actual)})", spread, *agreements))
    yield from table(("scene", "frames", "cause", "actual", "of the frame", "of the pose alone"), rows)
    yield ""
    telling = sum(is_telling(of_cause) for *_, of_cause in all_cells)
    for key, of_what in (("told", "Of rendered frames"), ("of_pose", "Of poses alone")):
        wrong = [f"{cause} of {name}" for name, cause, one in all_cells if error(one, key) > ERROR]
        mixed = [
            f"{cause} of {name}"
            for name, cause, one in all_cells
            if is_telling(one) and rank_correlation(one, key) < RANK
        ]
        listed, disordered = (", ".join(names) or "none" for names in (wrong, mixed))
        yield f"{of_what}, {len(wrong)} of {len(all_cells)} errors are above {ERROR:g}: {listed}."
        yield f"{len(mixed)} of {telling} rank correlations are below {RANK:g}: {disordered}."
        yield ""
    pixels = ({"scene": name, "cause": cause, **of_cause["uncertainty"]} for name, cause, of_cause in all_cells)
    numbers = {"expected": "{expected:.3f}", "actual": "{actual:.3f}"}
    shares = {"within 1σ": "{within_1:.0%}", "within 2σ": "{within_2:.0%}"}
    yield from columns(pixels, {"scene": "{scene}", "cause": "{cause}", **numbers, **shares})


if __name__ == "__main__":
    measure_runs("confidence", __doc__, {name: partial(measure, name) for name in (*IN_SILICO, *RECORDED)}, threads=1)
