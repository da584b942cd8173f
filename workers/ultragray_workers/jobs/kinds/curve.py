"""The training curve of a job as a picture."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

_POINTS = 300  # of the loss, however long the run
_COLOUR = "#0b6e99"


def draw_training_curve(journal: Path, path: Path) -> None:
    """PNG of the loss of each step (means of neighbours in a long run) and of the held-out PSNR on the way."""
    lines = [json.loads(line) for line in journal.read_text(encoding="utf-8").splitlines()]
    losses = np.array([line["loss"] for line in lines])
    width = max(1, len(losses) // _POINTS)
    count = len(losses) // width
    measured = [(line["step"], line["val_psnr_db"]) for line in lines if "val_psnr_db" in line]
    figure = Figure(figsize=(10.0, 3.0), layout="constrained")
    FigureCanvasAgg(figure)
    loss, held_out = figure.subplots(1, 2)
    steps = (np.arange(count) + 1) * width
    loss.plot(steps, losses[: count * width].reshape(count, width).mean(axis=1), linewidth=1.2, color=_COLOUR)
    loss.set(xlabel="step", ylabel="loss")
    held_out.plot([step for step, _ in measured], [value for _, value in measured], marker=".", color=_COLOUR)
    held_out.set(xlabel="step", ylabel="held-out PSNR, dB")
    figure.savefig(path, format="png", dpi=100)
