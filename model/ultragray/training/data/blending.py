"""Planes that lie between two frames, blended from what these show where the plane is in space."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ultragray.backends import cuda
from ultragray.probe import FloatArray, Probe
from ultragray.probe.scan_lines import Lines, ParallelLines

ON_PLANE_MM = 1e-6  # distances are at least that: the nearer frame then has all the weight


class Blend(NamedTuple):
    """V planes, and by how much the two frames differ there."""

    images: Tensor  # [V, H, W] in [0, 1]
    differences: Tensor  # [V, H, W] second less first; 0 where only one frame shows the pixel
    is_seen: Tensor  # [V, H, W] whether at least one does


def blend_by_pixel(images: Tensor, shares: FloatArray) -> Blend:  # [V, 2, H, W] in [0, 1], [V]
    """Each pixel from the same pixel of both frames; `shares` are those of the second one."""
    first, second = images.unbind(1)
    weights = cuda.upload(torch.from_numpy(shares).float(), images.device)
    blended = torch.lerp(first, second, weights[:, None, None])
    return Blend(blended, second - first, torch.ones_like(blended, dtype=torch.bool))


def blend_in_space(
    images: Tensor,  # [V, 2, H, W] in [0, 1], on any device
    frame_poses: FloatArray,  # [V, 2, 4, 4] mm
    poses: FloatArray,  # [V, 4, 4] mm, of the planes between
    probe: Probe,
) -> Blend:
    """The planes, as the baseline `linear` of `ultragray.evaluation` predicts them from two frames.

    Each pixel is projected onto both frames along their normals; their grey values there count in inverse proportion to
    the distances. A frame that the projection misses does not count; where it misses both, the pixel is 0.
    """
    views, _, height, width = images.shape
    rows, columns, distances = _projected(frame_poses.reshape(-1, 4, 4), np.repeat(poses, 2, axis=0), probe, images)
    sources = images.reshape(2 * views, 1, height, width)
    inside = (rows >= 0.0) & (rows <= 1.0)
    if probe.lines.wrap:
        sources = functional.pad(sources, (1, 1, 0, 0), mode="circular")
        columns = (columns % 1.0 * width + 1.0) / (width + 2)
    else:
        inside &= (columns >= 0.0) & (columns <= 1.0)
    places = torch.stack([2.0 * columns - 1.0, 2.0 * rows - 1.0], dim=-1)
    found = functional.grid_sample(sources, places, padding_mode="border", align_corners=False).reshape(images.shape)
    weights = torch.where(inside, 1.0 / distances.clamp(min=ON_PLANE_MM), 0.0).reshape(images.shape)
    is_in = inside.reshape(images.shape)
    blended = (weights * found).sum(dim=1) / weights.sum(dim=1).clamp(min=1e-9)
    return Blend(blended, (found[:, 1] - found[:, 0]) * is_in.all(dim=1), is_in.any(dim=1))


def _projected(
    onto: FloatArray,  # [P, 4, 4] mm
    poses: FloatArray,  # [P, 4, 4] mm
    probe: Probe,
    like: Tensor,  # [..., H, W], whose size and device the result has
) -> tuple[Tensor, Tensor, Tensor]:  # three of [P, H, W]
    """Where each pixel of an image falls on another one: row and column, from 0 to 1, and its distance (mm)."""
    height, width = like.shape[-2:]
    shares = [(np.arange(size) + 0.5) / size for size in (height, width)]
    x, _, z = np.moveaxis(probe.points_mm(*np.meshgrid(*shares, indexing="ij")), -1, 0)
    turns = np.einsum("pji,pjk->pik", onto[:, :3, :3], poses[:, :3, :3])
    shifts = np.einsum("pji,pj->pi", onto[:, :3, :3], poses[:, :3, 3] - onto[:, :3, 3])
    affine = np.stack([turns[:, :, 0], turns[:, :, 2], shifts], axis=-1)  # [P, 3, 3]: of x, of z, and the shift
    places = torch.from_numpy(np.stack([x, z, np.ones_like(x)]).reshape(3, -1)).float()
    local = cuda.upload(torch.from_numpy(affine).float(), like.device) @ cuda.upload(places, like.device)
    x, y, z = local.reshape(-1, 3, height, width).unbind(1)
    depth, across = _on_lines(probe.lines, x, z)
    rows = (depth - probe.near_mm) / probe.scan_line_length_mm
    return rows, (across - probe.lines.start) / probe.lines.span, y.abs()


def _on_lines(lines: Lines, x: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
    """`lines.coordinates` of tensors on any device; angles beyond the lines are not cut off."""
    if isinstance(lines, ParallelLines):
        along_x, along_z = lines.direction
        return z / along_z, x - z * (along_x / along_z)
    return torch.hypot(x, z), torch.rad2deg(torch.atan2(x, z))
