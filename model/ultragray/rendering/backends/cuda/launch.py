"""The host's side of the CUDA backend: tables, buffers and launches. Importing it imports Triton.

Nothing here waits for the device: sizes are known beforehand, so a CUDA graph can replay a frame.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import triton
from torch import Tensor

from ultragray.geometry.probe import FloatArray, Probe
from ultragray.rendering.backends.cuda.device import interpreted
from ultragray.rendering.backends.cuda.kernels import common as constants
from ultragray.rendering.backends.cuda.kernels.drawing import draw_tiles, finish_frames
from ultragray.rendering.backends.cuda.kernels.gathering import differentiate_pixels, gather_slices
from ultragray.rendering.backends.cuda.kernels.placing import place_gradients
from ultragray.rendering.backends.cuda.kernels.slicing import slice_gaussians
from ultragray.rendering.backends.inputs import THIN, BeamVariance, KernelLines, Kind
from ultragray.rendering.outputs import INTENSITY_SUM, PLANES, SUMS, WEIGHT_SUM
from ultragray.scene.info import expected_shapes

MAX_POSES = 65_535  # of one launch, by CUDA's limit for a grid


@dataclass(frozen=True)
class Shapes:
    """The partition of the work: Gaussians of a block, tiles of an image, and what one warp takes at a time."""

    block: int = 128
    tile_rows: int = 16
    tile_columns: int = 16
    slices_at_once: int = 1
    chunk: int = 128  # blocks whose bounds are tested together
    draw_warps: int = 1
    finish_columns: int = 64
    gather_rows: int = 16
    gather_columns: int = 8
    gatherers: int = 8  # programs that share the slices of a block
    pixel_rows: int = 32
    pixel_columns: int = 16


GPU_SHAPES = Shapes()
# The interpreter's cost is by operation, not by element: few and large steps.
INTERPRETER_SHAPES = Shapes(
    block=512,
    tile_rows=32,
    tile_columns=64,
    slices_at_once=64,
    chunk=1024,
    finish_columns=512,
    gather_rows=32,
    gather_columns=32,
    gatherers=1,
    pixel_rows=512,
    pixel_columns=512,
)


@contextlib.contextmanager
def launching(device: torch.device) -> Iterator[None]:
    """The context of every launch: Triton launches on the current device, and interpreted kernels warn of
    infinities, where a GPU just has them."""
    with torch.cuda.device(device) if device.type == "cuda" else np.errstate(all="ignore"):
        yield


class Geometry(NamedTuple):
    """A probe and an image size in the terms of the kernels."""

    fanned: bool
    wrap: bool  # the first line follows the last
    height: int
    width: int
    pitch: float  # between scan lines: cm, or radians for a fan
    row_cm: float
    thick: bool  # whether the slice has a thickness

    @classmethod
    def of(cls, probe: Probe, height: int, width: int, beam: Tensor | None = None) -> Geometry:
        lines, thick = KernelLines.of(probe), beam is not None
        return cls(lines.fanned, lines.wrap, height, width, lines.span / width, _row_cm(probe, height), thick)


def _row_cm(probe: Probe, height: int) -> float:
    return (probe.far_mm - probe.near_mm) / 10.0 / height


def view_table(
    probe: Probe,
    poses_cm: FloatArray,  # [C, 4, 4]
    height: int,
    beam: Tensor | None = None,  # [3] cm
) -> FloatArray:  # [C, VIEW]
    """Each pose as the kernels want it: the probe's axes and origin, the probe, and its beam."""
    lines = KernelLines.of(probe)
    table = np.empty((len(poses_cm), constants.VIEW.value))
    table[:, :9] = lines.view_axes(poses_cm)[:, :3, :3].transpose(0, 2, 1).reshape(-1, 9)
    table[:, 9:12] = poses_cm[:, :3, 3]
    depths_cm = probe.near_mm / 10.0, probe.cull_far_mm(height) / 10.0, _row_cm(probe, height)
    thickness = THIN if beam is None else BeamVariance.of(beam, probe, height)
    table[:, 12:] = *depths_cm, lines.start, lines.span, *thickness
    return table


@dataclass(frozen=True)
class Gaussians:
    """Raw parameters, each contiguous but for the rows of `shn`, in the order in which they are cut into blocks."""

    means: Tensor
    scales: Tensor
    quats: Tensor
    transmittances: Tensor
    sh0: Tensor
    shn: Tensor
    kind: Kind

    @classmethod
    def of(cls, splats: Mapping[str, Tensor], kind: Kind) -> Gaussians:
        raw = {name: tensor.detach() for name, tensor in splats.items()}
        shn = raw.pop("shN").squeeze(-1)
        return cls(
            **{name: tensor.contiguous() for name, tensor in raw.items()},
            shn=shn if shn.stride(-1) == 1 else shn.contiguous(),
            kind=kind,
        )

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """The six, in the order in which the kernels take them."""
        return self.means, self.scales, self.quats, self.transmittances, self.sh0, self.shn

    @property
    def sigmoid(self) -> bool:
        return self.kind.intensity == "sigmoid"

    @property
    def degree(self) -> int:
        return math.isqrt(self.shn.shape[1] + 1) - 1


@dataclass(frozen=True)
class Slices:
    """The results of one pass over the Gaussians on the device, for C poses and B blocks."""

    slices: Tensor  # [C, B, BLOCK, FIELDS]
    rectangles: Tensor  # [C, B, BLOCK, RECTANGLE] int32
    bounds: Tensor  # [C, B, 4] int32
    counts: Tensor  # [C, B] int32
    footprints: Tensor  # [C, B] int64, footprint pixels
    places: Tensor  # [C, B, BLOCK] int32, empty where it is not recorded


@dataclass(frozen=True)
class Planes:
    """S, the sum of I·w and T of each pixel, [C, H, W] each; T is whole only where it was to be kept."""

    weight: Tensor
    weighted: Tensor
    transmittance: Tensor


def bytes_per_pose(count: int, geometry: Geometry) -> int:
    """Of the device's memory that a pose takes beside its outputs: slices of `count` Gaussians, and planes."""
    places = -(-count // shapes().block) * shapes().block
    per_slice: int = constants.FIELDS.value + constants.RECTANGLE.value
    return 4 * (places * per_slice + 3 * geometry.height * geometry.width)


def shapes() -> Shapes:
    return INTERPRETER_SHAPES if interpreted() else GPU_SHAPES


def cut(gaussians: Gaussians, views: Tensor, geometry: Geometry, *, record: bool) -> Slices:
    """Slices of every pose of `views` [C, VIEW] float64."""
    how, device = shapes(), gaussians.means.device
    count, poses = len(gaussians.means), len(views)
    blocks = -(-count // how.block)
    places = poses * blocks * how.block
    slices = Slices(
        slices=torch.empty((places, constants.FIELDS.value), device=device),
        rectangles=torch.empty((places, constants.RECTANGLE.value), dtype=torch.int32, device=device),
        bounds=torch.empty((poses * blocks, 4), dtype=torch.int32, device=device),
        counts=torch.empty((poses, blocks), dtype=torch.int32, device=device),
        footprints=torch.empty((poses, blocks), dtype=torch.int64, device=device),
        places=torch.empty(places if record else 0, dtype=torch.int32, device=device),
    )
    if places:
        slice_gaussians[(blocks, poses)](
            views,
            *gaussians.tensors,
            *vars(slices).values(),
            count,
            gaussians.shn.stride(0),
            geometry.height,
            geometry.width,
            FANNED=geometry.fanned,
            WRAP=geometry.wrap,
            SIGMOID=gaussians.sigmoid,
            DEGREE=gaussians.degree,
            THICK=geometry.thick,
            WEIGHTED=gaussians.kind.weighted,
            RECORD=record,
            BLOCK=how.block,
            num_warps=4,
        )
    return slices


def empty_frames(outputs: Sequence[str], poses: int, geometry: Geometry, device: torch.device) -> dict[str, Tensor]:
    """Room for each output, [C, H, W]."""
    return {name: torch.empty((poses, geometry.height, geometry.width), device=device) for name in outputs}


def draw(
    slices: Slices, geometry: Geometry, frames: Mapping[str, Tensor], *, keep: bool, absorbs: bool = True
) -> Planes:
    """Fills the outputs, each [C, H, W] contiguous; returns the planes beneath them, with T where it is to be kept."""
    how, device = shapes(), slices.slices.device
    poses, blocks = slices.counts.shape
    height, width = geometry.height, geometry.width
    weight, weighted, transmittance = (torch.empty((poses, height, width), device=device) for _ in range(3))
    planes = Planes(frames.get(WEIGHT_SUM, weight), frames.get(INTENSITY_SUM, weighted), transmittance)
    if not poses:
        return planes
    tile_rows, tile_columns = -(-height // how.tile_rows), -(-width // how.tile_columns)
    steps = torch.empty((poses, tile_rows, width), device=device)
    draw_tiles[(tile_columns, tile_rows, poses)](
        slices.slices,
        slices.rectangles,
        slices.bounds,
        slices.counts,
        planes.weight,
        planes.weighted,
        planes.transmittance,
        steps,
        blocks,
        height,
        width,
        geometry.pitch,
        geometry.row_cm,
        FANNED=geometry.fanned,
        WRAP=geometry.wrap,
        ABSORBS=absorbs,
        BLOCK=how.block,
        S_LANES=how.slices_at_once,
        TILE_ROWS=how.tile_rows,
        TILE_COLUMNS=how.tile_columns,
        CHUNK=how.chunk,
        num_warps=how.draw_warps,
    )
    wanted = [frames.get(name) for name in PLANES]
    finish_frames[(-(-width // how.finish_columns), tile_rows, poses)](
        planes.weight,
        planes.weighted,
        planes.transmittance,
        steps,
        *(planes.weight if frame is None else frame for frame in wanted),
        height,
        width,
        int(keep),
        *(int(frame is not None) for frame in wanted),
        TILE_ROWS=how.tile_rows,
        COLUMNS=how.finish_columns,
        num_warps=4,
    )
    return planes


def differentiate(
    gaussians: Gaussians,
    views: Tensor,
    geometry: Geometry,
    slices: Slices,
    planes: Planes,
    gradients: Mapping[str, Tensor],  # of the loss by each output, [C, H, W] contiguous
    by_views: Tensor | None,  # [C, B, 2, 3] float64, zero
) -> tuple[dict[str, Tensor], Tensor]:
    """The gradient of the loss by every raw parameter, in its shape, and the moments of that by the beam [3].

    Where there is room for it, also by a shift and a turn of each view, block by block.
    """
    how, device = shapes(), gaussians.means.device
    height, width = geometry.height, geometry.width
    poses, blocks = slices.counts.shape
    count, terms = len(gaussians.means), (gaussians.degree + 1) ** 2
    shapes_by_name = expected_shapes(count, gaussians.degree)  # in the order in which the kernel takes them
    by_parameter = {name: torch.empty(shape, device=device) for name, shape in shapes_by_name.items()}
    by_beam = torch.zeros((blocks if geometry.thick else 0, 3), dtype=torch.float64, device=device)
    if not count:
        return by_parameter, by_beam.sum(dim=0)
    by_pixel = [torch.empty_like(planes.weight) for _ in range(4)]
    by_slice = torch.empty((poses * blocks * how.block, constants.GRADIENTS.value), device=device)
    by_output = [gradients.get(name) for name in (*PLANES, *SUMS)]
    if poses:
        differentiate_pixels[(-(-width // how.pixel_columns), poses)](
            planes.weight,
            planes.weighted,
            planes.transmittance,
            *(planes.weight if gradient is None else gradient for gradient in by_output),
            *by_pixel,
            height,
            width,
            *(int(gradient is not None) for gradient in by_output),
            ROWS=how.pixel_rows,
            COLUMNS=how.pixel_columns,
            num_warps=4,
        )
        gather_slices[(blocks, how.gatherers, poses)](
            slices.slices,
            slices.rectangles,
            slices.counts,
            *by_pixel,
            by_slice,
            blocks,
            height,
            width,
            geometry.pitch,
            geometry.row_cm,
            FANNED=geometry.fanned,
            WRAP=geometry.wrap,
            ABSORBS=not gaussians.kind.weighted,
            BLOCK=how.block,
            S_LANES=how.slices_at_once,
            ROWS=how.gather_rows,
            COLUMNS=how.gather_columns,
            num_warps=1,
        )
    place_gradients[(blocks,)](
        views,
        *gaussians.tensors,
        slices.rectangles,
        slices.counts,
        slices.places,
        by_slice,
        *by_parameter.values(),
        views if by_views is None else by_views,
        by_beam,
        poses,
        count,
        gaussians.shn.stride(0),
        width,
        FANNED=geometry.fanned,
        SIGMOID=gaussians.sigmoid,
        DEGREE=gaussians.degree,
        THICK=geometry.thick,
        WEIGHTED=gaussians.kind.weighted,
        TERMS=max(2, triton.next_power_of_2(terms)),
        BY_VIEW=by_views is not None,
        BLOCK=how.block,
        num_warps=4,
    )
    return by_parameter, by_beam.sum(dim=0)
