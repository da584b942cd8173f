"""Planes that lie between two frames, blended from what these show where the plane is in space."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ...backends import cuda
from ...probe import FloatArray, Probe

GRID = 17  # points a side that are projected from plane to plane; between them the projection is taken to be linear
ON_PLANE_MM = 1e-6  # distances are at least that: the nearer frame then has all the weight


class Blend(NamedTuple):
    """V planes, and by how much the two frames differ there; 0 where only one shows it."""

    images: Tensor  # [V, H, W] in [0, 1]
    differences: Tensor  # [V, H, W] second less first


def blend_by_pixel(images: Tensor, shares: FloatArray) -> Blend:  # [V, 2, H, W] in [0, 1], [V]
    """Each pixel from the same pixel of both frames; `shares` are those of the second one."""
    first, second = images.unbind(1)
    weights = cuda.upload(torch.from_numpy(shares).float(), images.device)
    return Blend(torch.lerp(first, second, weights[:, None, None]), second - first)


def blend_in_space(
    images: Tensor,  # [V, 2, H, W] in [0, 1], on any device
    sides: FloatArray,  # [V, 2, 4, 4] mm, the poses of these frames
    poses: FloatArray,  # [V, 4, 4] mm, of the planes between
    probe: Probe,
) -> Blend:
    """The planes, as the baseline `linear` of `ultragray.evaluation` predicts them from two frames.

    Each pixel is projected onto both frames along their normals; their grey values there count in inverse proportion to
    the distances. A frame that the projection misses does not count; where it misses both, the pixel is 0.
    """
    views, _, height, width = images.shape
    moves = torch.from_numpy(_moves(sides, poses, probe, height, width)).float()
    moves = cuda.upload(moves, images.device).reshape(2 * views, 3, GRID, GRID)
    fields = functional.interpolate(moves, (height, width), mode="bilinear", align_corners=True)
    rows, columns, distances = fields.unbind(1)  # [2V, H, W]
    rows = rows + _middles(height, images.device)[:, None]
    columns = columns + _middles(width, images.device)
    sources = images.reshape(2 * views, 1, height, width)
    inside = (rows >= 0.0) & (rows <= 1.0)
    if probe.lines.wrap:
        sources = functional.pad(sources, (1, 1, 0, 0), mode="circular")
        columns = (columns % 1.0 * width + 1.0) / (width + 2)
    else:
        inside &= (columns >= 0.0) & (columns <= 1.0)
    places = torch.stack([2.0 * columns - 1.0, 2.0 * rows - 1.0], dim=-1)
    seen = functional.grid_sample(sources, places, padding_mode="border", align_corners=False)[:, 0]
    weights = torch.where(inside, 1.0 / distances.clamp(min=ON_PLANE_MM), 0.0).reshape(images.shape)
    seen = seen.reshape(images.shape)
    blended = (weights * seen).sum(dim=1) / weights.sum(dim=1).clamp(min=1e-9)
    in_both = inside.reshape(images.shape).all(dim=1)
    return Blend(blended, (seen[:, 1] - seen[:, 0]) * in_both)


def _moves(
    sides: FloatArray, poses: FloatArray, probe: Probe, height: int, width: int
) -> FloatArray:  # [V, 2, 3, GRID, GRID]
    """How far the projection of a point onto a frame lies from its own place in the image, and from the frame (mm).

    Rows and columns are in shares of the image; on a grid from the first to the last pixel.
    """
    rows, columns = (np.linspace(0.5 / size, 1.0 - 0.5 / size, GRID) for size in (height, width))
    rows, columns = np.meshgrid(rows, columns, indexing="ij")
    points = np.einsum("vij,rcj->vrci", poses[:, :3, :3], probe.points_mm(rows, columns)) + poses[:, None, None, :3, 3]
    local = np.einsum("vsij,vsrci->vsrcj", sides[..., :3, :3], points[:, None] - sides[:, :, None, None, :3, 3])
    depth, across = probe.lines.coordinates(local[..., 0], local[..., 2])
    down = (depth - probe.near_mm) / probe.scan_line_length_mm - rows
    right = (across - probe.lines.start) / probe.lines.span - columns
    if probe.lines.wrap:
        right -= np.round(right)
    return np.stack([down, right, np.abs(local[..., 1])], axis=2)


def _middles(pixels: int, device: torch.device) -> Tensor:  # [pixels]
    """Places of the middles of pixels along a side of the image, from 0 to 1."""
    return (torch.arange(pixels, device=device) + 0.5) / pixels
