"""Rendered frames as a sonographer has set the display: the pixel work, where the frames are."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, pad

from ultragray.display.scan_conversion import samples
from ultragray.display.settings import FRAME_RANGE_DB, Display
from ultragray.outputs import OUTPUTS
from ultragray.probe import Probe

_CACHED_PICTURES = 8  # at 9 bytes a pixel
_LARGEST_CACHED_PICTURE = 2**20  # pixels


def show(
    frames: Mapping[str, Tensor], probe: Probe, display: Display, blackened: Tensor | None = None
) -> dict[str, Tensor]:
    """Each output [C, H, W] as `display` shows it, [C, H', W'] of `Display.picture`, in the type that it had.

    Pixels that are `blackened`, [C, H, W] bool, are 0 in every output but those that tell support, whatever the gain.
    """
    shown = {}
    for name, pixels in frames.items():
        rows = display.rows_shown(probe, pixels.shape[1])
        shown[name] = pixels[:, :rows]
        if OUTPUTS[name].is_toned and display.changes_tone:
            shown[name] = _toned(shown[name], display)
        if OUTPUTS[name].is_toned and display.edge:
            shown[name] = _edged(shown[name], display.edge)
        if blackened is not None and not OUTPUTS[name].tells_support:
            shown[name] = shown[name].masked_fill(blackened[:, :rows], 0)
        if display.pixel_mm is not None:
            cropped = probe.cropped(rows / pixels.shape[1])
            shown[name] = _scan_converted(shown[name], cropped, display.pixel_mm, nearest=OUTPUTS[name].is_numbers)
        if display.flip:
            shown[name] = shown[name].flip(2)
        shown[name] = shown[name].contiguous()
    return shown


def _toned(bmode: Tensor, display: Display) -> Tensor:  # [C, H, W] -> [C, H, W]
    """Grey levels of each echo raised by its gain: 0 dB is white, `dynamic_range_db` below it black."""
    gains = torch.from_numpy(display.gains(bmode.shape[1])).to(bmode)[:, None]
    scale = FRAME_RANGE_DB / display.dynamic_range_db
    return (bmode * scale + (1.0 - scale + gains / display.dynamic_range_db)).clamp_(0.0, 1.0)


def _edged(bmode: Tensor, edge: float) -> Tensor:  # [C, H, W] -> [C, H, W]
    """Unsharp masking by the mean of 3x3 samples; at the border the outermost ones count twice."""
    blurred = avg_pool2d(pad(bmode[None], (1, 1, 1, 1), mode="replicate"), 3, stride=1)[0]
    return (bmode + edge * (bmode - blurred)).clamp_(0.0, 1.0)


def _scan_converted(frames: Tensor, probe: Probe, pixel_mm: float, *, nearest: bool) -> Tensor:  # -> [C, H', W']
    _, height, width = frames.shape
    picture = probe.picture(pixel_mm)
    is_small = picture.height * picture.width <= _LARGEST_CACHED_PICTURE
    grid, inside = (_cached_grid if is_small else _grid)(probe, height, width, pixel_mm, frames.device)
    floats = frames if frames.is_floating_point() else frames.float()
    if probe.lines.wrap:
        floats = torch.cat([floats[..., -1:], floats, floats[..., :1]], dim=-1)
    mode = "nearest" if nearest else "bilinear"
    shown = grid_sample(floats[None], grid.to(floats), mode, padding_mode="border", align_corners=False)[0]
    shown *= inside
    return shown if frames.is_floating_point() else shown.round_().to(frames.dtype)


def _grid(
    probe: Probe, height: int, width: int, pixel_mm: float, device: torch.device
) -> tuple[Tensor, Tensor]:  # [1, H', W', 2], [H', W']
    """The place of each pixel of the picture, from −1 to 1 across the frame, and whether anything is there."""
    rows, columns, inside = samples(probe, (height, width), pixel_mm)
    if probe.lines.wrap:  # the frame is then given the first column once more after the last, and the other way round
        columns, width = columns + 1.0, width + 2
    grid = np.stack([(2 * columns + 1) / width - 1, (2 * rows + 1) / height - 1], axis=-1)
    return torch.from_numpy(grid.astype(np.float32))[None].to(device), torch.from_numpy(inside).to(device)


_cached_grid = lru_cache(maxsize=_CACHED_PICTURES)(_grid)
