"""The Gaussians that a training starts from, as raw parameters (docs/physics.md §2), lengths in cm.

An informed start samples the volume as the frames saw it: a plane is drawn between neighbouring frames, a pixel on it,
and the Gaussian there gets the turn of the nearer frame, the elevation of a slice and the brightness that both frames
show. A pixel in shadow shows B = E·T with T < 1; as the start absorbs hardly anything, its echo is estimated as B / T
from the share of the beam that the frame itself says is left, at most 1.5 times the smoothed tissue, and where nearly
nothing is left the smoothed tissue itself. A floor under it makes what lies above learn to absorb.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from ultragray.geometry.pose import quaternion_from_pose
from ultragray.geometry.probe import FloatArray
from ultragray.learn.sweep import Dataset, IntArray, Sweep
from ultragray.learn.training.between import Neighbours, draw_places
from ultragray.learn.training.config import TrainingConfig
from ultragray.learn.training.geometry import SPENT, Geometry, Shadows
from ultragray.learn.training.intensity import sh0_of_intensity
from ultragray.rendering.backends.inputs import spatial_order
from ultragray.scene.gaussians import PARAMETERS
from ultragray.scene.info import expected_shapes

NO_ABSORPTION_LOGIT = 30.0  # τ = 1 to the last bit of a float32
RELEASED_INTENSITY = 0.6  # of the released start: sh0 = (0.1 − 0.5) / 0.28209
RELEASED_CUBE = 0.8  # half-side of the released start, × scene scale
BEYOND_ELEVATION = 0.5  # standard deviation along elevation beyond an end, × the distance from it
UNPRUNED = 0.9  # of the standard deviation above which a refinement prunes
DETAIL_MM = 1.0  # standard deviation of the Gaussian beyond which structure is no detail, and over which it is averaged
DENSITY, PLAIN = 2 / 3, 0.1  # the former has the least error of means over squares; of the mean, where nothing is
SIZES, WIDER = (0.3, 3.0), 2.0  # of the usual one; times as wide as deep
MOST_LIT = 1.5  # × the smoothed brightness: what noise in a shadow may be brightened to


class Start(NamedTuple):
    """The Gaussians of a start, in spatial order."""

    parameters: dict[str, Tensor]  # the six raw tensors
    floor: Tensor  # [N] the least intensity of each, as long as floors hold


def initial_parameters(
    dataset: Dataset,
    neighbours: Neighbours,
    shadows: Shadows | None,  # None: nothing absorbs
    geometry: Geometry,
    config: TrainingConfig,
    generator: torch.Generator,
    *,
    by_detail: bool = False,
) -> Start:
    """The start, float32, drawn with `generator` alone; `config` leaves nothing open.

    `random` draws means uniformly in the released cube, round Gaussians of one intensity. `informed` draws pixels of
    planes between neighbouring frames and beyond the ends (`between.draw_places`) and puts a Gaussian on each, turned
    like a frame there and as thick as a slice, with the frames' brightness there as its intensity. Where the frames
    show a shadow (`shadows`) it gets the intensity that the whole beam would show, and a floor of nearly that, so that
    what is above it must absorb. `by_detail`: more and smaller ones where the frames show detail, wider than deep, as
    echoes are: few Gaussians then show more from the first step on.
    """
    count = config.initial_gaussians
    assert count is not None
    assert config.initial_scale_mm is not None
    assert config.initial_elevation_mm is not None
    assert config.intensity_floor is not None
    shapes = expected_shapes(count, config.sh_degree)
    quats = torch.zeros(shapes["quats"])
    quats[:, 0] = 1.0
    scales_mm = torch.full(shapes["scales"], config.initial_scale_mm)
    floor = torch.zeros(count)
    if config.start == "random":
        means = (2.0 * torch.rand((count, 3), generator=generator) - 1.0) * RELEASED_CUBE * geometry.scene_scale_cm
        brightness = torch.full((count,), RELEASED_INTENSITY)
    elif config.start == "informed":
        pixels = _on_planes(dataset, neighbours, count, shadows, generator, by_detail)
        means = torch.from_numpy((pixels.points_mm - geometry.centre_mm) / 10.0).float()
        brightness = torch.from_numpy(pixels.brightness).float()
        floor = config.intensity_floor * torch.from_numpy(pixels.unshadowed).float()
        turns = torch.tensor([quaternion_from_pose(pose) for pose in dataset.train.poses])
        quats = turns[pixels.frames]
        most_mm = max(10.0 * UNPRUNED * config.prune_above * geometry.scene_scale_cm, config.initial_elevation_mm)
        beyond_mm = torch.from_numpy(BEYOND_ELEVATION * np.abs(pixels.beyond_mm)).float()
        scales_mm[:, 1] = beyond_mm.clamp(config.initial_elevation_mm, most_mm)
        scales_mm[:, ::2] *= torch.from_numpy(pixels.sizes).float()
    else:
        raise AssertionError(config.start)
    logit = math.log(config.initial_transmittance / (1.0 - config.initial_transmittance))
    parameters = {
        "means": means,
        "scales": torch.log(scales_mm / 10.0),
        "quats": quats,
        "transmittances": torch.full(shapes["transmittances"], logit if config.transmittance else NO_ABSORPTION_LOGIT),
        "sh0": sh0_of_intensity(brightness, config.intensity).reshape(shapes["sh0"]),
        "shN": torch.zeros(shapes["shN"]),
    }
    order = spatial_order(means)
    return Start({name: parameters[name][order].contiguous() for name in PARAMETERS}, floor[order])


class _Pixels(NamedTuple):
    """N pixels of planes of a sweep."""

    frames: IntArray  # [N] the nearer of the two that its plane lies between
    points_mm: FloatArray  # [N, 3] in the tracker's frame
    beyond_mm: FloatArray  # [N] distance of the plane from an end of the sweep, 0 within it
    brightness: FloatArray  # [N] in [0, 1], with the whole beam
    unshadowed: FloatArray  # [N] the part of it that smooth tissue has where it is in a shadow, else 0
    sizes: FloatArray  # [N, 2] laterally and axially, of the usual one


def _on_planes(
    dataset: Dataset,
    neighbours: Neighbours,
    count: int,
    shadows: Shadows | None,
    generator: torch.Generator,
    by_detail: bool,
) -> _Pixels:
    sweep, probe = dataset.train, dataset.probe
    places = draw_places(neighbours, count, generator)
    across, deep = torch.rand((2, count), generator=generator, dtype=torch.float64).numpy()  # share of the image
    sizes = np.ones((count, 2))
    if by_detail:
        deep, across, sizes = _where_detail_is(sweep, places.nearer, deep, across, generator)
    points_mm = probe.points_mm(deep, across)
    poses = places.poses(sweep)
    tracked_mm = np.einsum("nij,nj->ni", poses[:, :3, :3], points_mm) + poses[:, :3, 3]
    rows, columns = (deep * sweep.height).astype(np.int64), (across * sweep.width).astype(np.int64)
    brightness, unshadowed = np.zeros((2, 2, count))  # [2, N] each, of the two frames
    for frame in np.unique(places.frames):
        beam = shadows.of(frame) if shadows is not None else None
        for side in (0, 1):
            (own,) = np.nonzero(places.frames[:, side] == frame)
            pixels = rows[own], columns[own]
            grey = sweep.images[frame][pixels] / 255.0
            if beam is None:
                brightness[side, own] = grey
                continue
            share, echo, hidden = (values[pixels] for values in (beam.share, beam.echo, beam.is_shadowed))
            lit = np.where(share < SPENT, echo, np.minimum(grey / np.maximum(share, SPENT), MOST_LIT * echo))
            brightness[side, own] = np.where(hidden, lit, grey)
            unshadowed[side, own] = np.where(hidden, echo, 0.0)
    nearer = (places.shares > 0.5).astype(np.int64), np.arange(count)
    return _Pixels(
        frames=places.nearer,
        points_mm=tracked_mm,
        beyond_mm=places.beyond_mm,
        brightness=brightness[nearer],
        unshadowed=unshadowed[nearer],
        sizes=sizes,
    )


def _where_detail_is(
    sweep: Sweep, frames: IntArray, deep: FloatArray, across: FloatArray, generator: torch.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:  # [N] each -> [N], [N], [N, 2]
    """Places in frames as dense as their detail to the power DENSITY, given ones within a pixel, and sizes there."""
    drawn = torch.rand(len(frames), generator=generator, dtype=torch.float64).numpy()
    deep, across, sizes = deep.copy(), across.copy(), np.empty((len(frames), 2))
    axial, lateral = (max(0.5, DETAIL_MM / pixel_mm) for pixel_mm in sweep.pixel_mm)
    blurred = partial(cv2.GaussianBlur, ksize=(0, 0), sigmaX=lateral, sigmaY=axial, borderType=cv2.BORDER_REPLICATE)
    for frame in np.unique(frames):
        (own,) = np.nonzero(frames == frame)
        image = sweep.images[frame].astype(np.float32)
        density = np.float64(blurred(np.abs(image - blurred(image)))) ** DENSITY + 1e-9
        density = (density / density.mean() + PLAIN) / (1.0 + PLAIN)
        summed = np.cumsum(density)
        chosen = np.searchsorted(summed, drawn[own] * summed[-1]).clip(max=density.size - 1)
        rows, columns = np.divmod(chosen, sweep.width)
        deep[own], across[own] = (rows + deep[own]) / sweep.height, (columns + across[own]) / sweep.width
        size = np.clip(density.ravel()[chosen] ** -0.5, *SIZES)
        sizes[own] = size[:, None] * (WIDER**0.5, WIDER**-0.5)
    return deep, across, sizes
