"""A picture of a dataset: its image planes in space, and a contact sheet of its frames."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ultragray.files import atomic_path
from ultragray.geometry.probe import FloatArray
from ultragray.geometry.scan_conversion import with_square_pixels
from ultragray.learn.sweep import Dataset, Sweep, spread_places

TRAIN_COLOUR, VAL_COLOUR = "#1f77b4", "#d62728"
MAX_PLANES = 16  # outlines of one part: more are a thicket; the path of the probe shows every frame
SHEET_COLUMNS, MAX_SHEET_FRAMES = 8, 24
MAX_TILE_PIXELS = 256
VIEWS_DEG = ((20.0, -60.0), (20.0, 30.0))  # elevation and azimuth of the eye


def draw_dataset(dataset: Dataset, path: str | Path) -> None:
    """Write a PNG: the planes seen from two sides, below them frames at even distances, held-out ones in red.

    Of many planes a few are drawn, at even distances, as the legend says. Axes are those of the tracker,
    in mm. Frames are scan-converted.
    """
    shown = _sheet_frames(dataset)
    rows = math.ceil(len(shown) / SHEET_COLUMNS)
    tile = _tile(*shown[0][:2])
    tile_height = 14.0 / SHEET_COLUMNS * tile.shape[0] / tile.shape[1] + 0.25
    # Everything has a fixed place: matplotlib's constrained layout draws it all twice, and takes longer than the rest.
    figure = Figure(figsize=(14.0, 7.0 + rows * tile_height), dpi=100)
    FigureCanvasAgg(figure)
    parts = figure.add_gridspec(2, 1, height_ratios=[7.0, rows * tile_height], hspace=0.0)
    above, below = figure.add_subfigure(parts[0]), figure.add_subfigure(parts[1])
    above.suptitle(f"{dataset.name}: {len(dataset.train)} training frames (blue), {len(dataset.val)} held out (red)")
    for place, (elevation, azimuth) in enumerate(VIEWS_DEG):
        axes = above.add_axes((0.02 + 0.49 * place, 0.03, 0.46, 0.88), projection="3d")
        _draw_planes(axes, dataset, elevation, azimuth)
    sheet = below.add_axes((0.0, 0.0, 1.0, 1.0))  # a column is 1 wide, a row is 1 high
    sheet.set_axis_off()
    side, height = 0.96, 0.96 * (1.0 - 0.25 / tile_height)  # the rest of a row is for the title
    for place, (sweep, frame, colour) in enumerate(shown):
        row, column = divmod(place, SHEET_COLUMNS)
        left, bottom = column + 0.02, rows - row - 1.0
        box = (left, left + side, bottom, bottom + height)
        sheet.imshow(_tile(sweep, frame), cmap="gray", vmin=0, vmax=255, extent=box, aspect="auto")
        title = f"{'train' if colour == TRAIN_COLOUR else 'val'} {sweep.frame_numbers[frame]}"
        sheet.text(left + side / 2, bottom + height, title, color=colour, fontsize=9, ha="center", va="bottom")
    sheet.set(xlim=(0.0, SHEET_COLUMNS), ylim=(0.0, rows))
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png")


def _sheet_frames(dataset: Dataset) -> list[tuple[Sweep, int, str]]:
    """Frames at even distances, held-out ones at most a third of them."""
    val_count = min(len(dataset.val), MAX_SHEET_FRAMES // 3)
    train_count = min(len(dataset.train), MAX_SHEET_FRAMES - val_count)
    return [
        (sweep, int(frame), colour)
        for sweep, count, colour in ((dataset.train, train_count, TRAIN_COLOUR), (dataset.val, val_count, VAL_COLOUR))
        for frame in spread_places(len(sweep), count)
    ]


def _tile(sweep: Sweep, frame: int) -> np.ndarray:  # [rows, columns]
    """A frame with square pixels, MAX_TILE_PIXELS on its longer side."""
    return with_square_pixels(sweep.images[frame].astype(np.float32), sweep.probe, MAX_TILE_PIXELS)


def _draw_planes(axes: Any, dataset: Dataset, elevation_deg: float, azimuth_deg: float) -> None:
    corners = [part.corners_mm() for part in (dataset.train, dataset.val)]
    # dashes and smaller dots: held-out frames close to training frames do not hide them
    parts = (("training", dataset.train, TRAIN_COLOUR, "-", 3.0), ("held out", dataset.val, VAL_COLOUR, "--", 1.5))
    for (name, part, colour, style, dot_size), part_corners in zip(parts, corners, strict=True):
        if not len(part):
            continue
        faces = part_corners[:, : part_corners.shape[1] // 2].mean(axis=1)  # middle of the near edge
        axes.plot(*faces.T, ".", color=colour, markersize=dot_size)
        thinned = part_corners[spread_places(len(part), MAX_PLANES)]
        shown = f"{len(thinned)} of {len(part)} planes" if len(thinned) < len(part) else "every plane"
        axes.plot(*_outlines(thinned).T, style, color=colour, linewidth=0.7, alpha=0.6, label=f"{name}: {shown}")
    for line in axes.legend(loc="upper left", fontsize=9).get_lines():
        line.set(alpha=1.0, linewidth=1.5)
    every = np.concatenate([part.reshape(-1, 3) for part in corners])
    low, high = every.min(axis=0), every.max(axis=0)
    middle, half = (low + high) / 2, max(float((high - low).max()) / 2, 1.0)
    for axis, centre in zip("xyz", middle, strict=True):
        getattr(axes, f"set_{axis}lim")(centre - half, centre + half)
        getattr(axes, f"set_{axis}label")(f"{axis}, mm")
    axes.set_box_aspect((1, 1, 1))
    axes.view_init(elev=elevation_deg, azim=azimuth_deg)


def _outlines(corners: FloatArray) -> FloatArray:  # [F, P, 3] -> [F * (P + 2), 3]
    """Closed outlines, along the near edge and back along the far edge; NaN lifts the pen between them."""
    half = corners.shape[1] // 2
    order = [*range(half), *reversed(range(half, 2 * half)), 0]
    lifts = np.full((len(corners), 1, 3), np.nan)
    return np.concatenate([corners[:, order], lifts], axis=1).reshape(-1, 3)
