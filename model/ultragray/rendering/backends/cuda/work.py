"""The work of a frame: bytes read and written and operations of the kernels, counted from the slices of real poses.

The counts turn a measured time into a share of what the hardware could do. Importing this imports Triton.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ultragray.geometry.probe import FloatArray, Probe
from ultragray.rendering.backends.cuda.device import upload
from ultragray.rendering.backends.cuda.frames import sorted_gaussians
from ultragray.rendering.backends.cuda.kernels import common as constants
from ultragray.rendering.backends.cuda.launch import Geometry, cut, launching, shapes, view_table
from ultragray.scene.gaussians import GaussianScene

# Floating-point operations, counted in the source; a fused multiply-add is two.
OPERATIONS_PER_GAUSSIAN = 110  # the cull by the image plane
OPERATIONS_PER_SLICE = 500  # float64, cutting
OPERATIONS_PER_EVALUATION = 45  # a pixel of a slice: w, psi, alpha and what they are added to
GAUSSIAN_BYTES = 4 * (3 + 3 + 4)  # read to cull: mean, scales, quaternion
PLANES = 3  # S, the sum of I·w and T: written by the tiles, read to finish


@dataclass(frozen=True)
class Work:
    """Of one frame, the mean over the poses counted."""

    gaussians: int
    slices: float  # Gaussians that the image plane cuts
    footprint_pixels: float  # of all slices: what has to be evaluated
    tile_visits: float  # slices times the tiles that each touches
    pixel_evaluations: float  # what is evaluated, tile by tile
    bytes_read: float
    bytes_written: float
    operations: float


def count_work(
    scene: GaussianScene,
    probe: Probe,
    poses_cm: FloatArray,  # [C, 4, 4] about the scene's centre
    height: int,
    width: int,
) -> Work:
    """The work of rendering one B-mode frame, from the slices of the given poses.

    Bytes are those that must move once: the Gaussians, the slices out and in, the planes out and in, the frame. What
    caches serve again is not counted.
    """
    geometry, how = Geometry.of(probe, height, width), shapes()
    views = upload(torch.from_numpy(view_table(probe, poses_cm, height)), scene.means.device)
    gaussians = sorted_gaussians(scene)
    with launching(scene.means.device):
        slices_of_poses = cut(gaussians, views, geometry, record=False)
    poses = len(views)
    rank = torch.arange(how.block, device=slices_of_poses.counts.device)
    present = (rank < slices_of_poses.counts[:, :, None]).reshape(-1)  # [C * B * BLOCK]
    edges = slices_of_poses.rectangles[present].long()
    first_column, last_column, first_row, last_row = (edges[:, k] for k in range(4))
    pixels = (last_column - first_column + 1) * (last_row - first_row + 1)
    across = last_column // how.tile_columns - first_column // how.tile_columns + 1
    visits = across * (last_row // how.tile_rows - first_row // how.tile_rows + 1)
    slices = len(edges) / poses
    tile_visits = float(visits.sum()) / poses
    evaluations = tile_visits * how.tile_rows * how.tile_columns
    slice_bytes = 4 * slices * (constants.FIELDS.value + constants.RECTANGLE.value)
    plane_bytes = 4 * PLANES * height * width
    return Work(
        gaussians=len(gaussians.means),
        slices=slices,
        footprint_pixels=float(pixels.sum()) / poses,
        tile_visits=tile_visits,
        pixel_evaluations=evaluations,
        bytes_read=GAUSSIAN_BYTES * len(gaussians.means) + slice_bytes + plane_bytes,
        bytes_written=slice_bytes + plane_bytes + 4 * height * width,
        operations=OPERATIONS_PER_GAUSSIAN * len(gaussians.means)
        + OPERATIONS_PER_SLICE * slices
        + OPERATIONS_PER_EVALUATION * evaluations,
    )
