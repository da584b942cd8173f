"""What a motion of the probe within its image plane does to a frame, by the frame alone: its pixels slide.

Shadows and gain slide along, which they would not quite do in a frame rendered there. To tell the next step of a search
that is near enough, and it takes no rendering.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ultragray.evaluation.compounding import pixel_positions_mm
from ultragray.probe import FloatArray, Probe

IN_PLANE = (0, 2, 4)  # of the six numbers of a motion: shifts along lateral and axial axis, the turn about elevation


def places_after(probe: Probe, motions: Tensor, rows: int, columns: int) -> Tensor:
    """Where in a frame [rows, columns] the pixels of frames after motions [S, 4, 4] lie: [S, rows, columns, 2].

    The two numbers are column and row in [-1, 1], as functional.grid_sample() takes them.
    """
    pixels = pixel_positions_mm(probe, rows, columns)
    moves = motions.numpy()
    moved = pixels @ moves[:, :3, :3].transpose(0, 2, 1) + moves[:, None, :3, 3]
    depth, across = (share.reshape(rows, columns) for share in _coordinates(probe, pixels))
    rows_after, columns_after = _coordinates(probe, moved)
    places = np.stack(
        [
            2.0 * (columns_after - across[0, 0]) / (across[0, -1] - across[0, 0]) - 1.0,
            2.0 * (rows_after - depth[0, 0]) / (depth[-1, 0] - depth[0, 0]) - 1.0,
        ],
        axis=-1,
    )
    return torch.from_numpy(places.reshape(len(motions), rows, columns, 2)).float()


def slid(frames: Tensor, places: Tensor) -> Tensor:  # [K, H, W], [S, H, W, 2] -> [K, S, H, W]
    """Each frame after each step, by places_after(); what comes in from outside is as the edge was."""
    count, rows, columns = frames.shape
    repeated = frames[:, None].expand(count, len(places), rows, columns).reshape(-1, 1, rows, columns)
    grid = places.repeat(count, 1, 1, 1)
    after = functional.grid_sample(repeated, grid, mode="bicubic", padding_mode="border", align_corners=True)
    return after.reshape(count, len(places), rows, columns)


def _coordinates(probe: Probe, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:  # [..., 3] -> [...] each
    """Depth and place across the scan lines."""
    return probe.lines.coordinates(points_mm[..., 0], points_mm[..., 2])
