"""The second echo: beyond the first strong interface of a scan line, a mirror image of what lies before it."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool1d

from ultragray.probe import Probe

STRONG_BMODE = 0.6  # of an interface that mirrors
LEAST_DEPTH_MM = 5.0  # below the face, whose own bright lines mirror nothing
SMOOTHED_SHARE = 0.06  # of the lines
GHOST_PLANES = ("bmode", "echo", "transmittance")
_LEAST_BEAM = 1e-6


def add_ghosts(planes: dict[str, Tensor], probe: Probe, share: float) -> None:
    """Puts ghosts into GHOST_PLANES [C, H, W], all of which are there. B-mode stays E·T; gradients pass to the planes.

    Of what is heard from a row d beyond the interface, `share` is what is heard from the row d before it: B-mode and
    transmittance are the means of the two rows by these shares.
    """
    bmode = planes["bmode"]
    height = bmode.shape[1]
    interface = _interfaces(bmode.detach(), probe)[:, None]  # [C, 1, W]
    rows = torch.arange(height, device=bmode.device)[:, None]
    mirrored = 2 * interface - rows  # [C, H, W]
    ghosted = (rows > interface) & (mirrored >= 0)
    shares = share * ghosted.to(bmode.dtype)

    def with_mirror(plane: Tensor) -> Tensor:
        return plane + shares * (plane.gather(1, mirrored.clamp(0, height - 1)) - plane)

    heard = with_mirror(planes["transmittance"])
    planes["bmode"] = with_mirror(bmode)
    planes["echo"] = torch.where(ghosted, planes["bmode"] / heard.clamp(min=_LEAST_BEAM), planes["echo"])
    planes["transmittance"] = heard


def _interfaces(bmode: Tensor, probe: Probe) -> Tensor:  # [C, H, W] -> [C, W]
    """The row of the first strong interface of each line, the height where there is none.

    A surface runs on from line to line where speckle does not: B-mode is averaged across lines, and rows are medians.
    """
    height, width = bmode.shape[1:]
    deep = torch.from_numpy(probe.depths_mm(height) - probe.face_depth_mm >= LEAST_DEPTH_MM).to(bmode.device)
    beside = round(width * SMOOTHED_SHARE / 2.0)
    wrap = probe.lines.wrap
    averaged = avg_pool1d(_padded(bmode, beside, wrap=wrap), 2 * beside + 1, stride=1)
    strong = (averaged >= STRONG_BMODE) & deep[:, None]
    first = torch.where(strong.any(dim=1), strong.int().argmax(dim=1), height)
    return _padded(first, beside, wrap=wrap).unfold(-1, 2 * beside + 1, 1).median(dim=-1).values


def _padded(values: Tensor, beside: int, *, wrap: bool) -> Tensor:  # [..., W] -> [..., beside + W + beside]
    """With more values on either side: those that follow where lines go all the way round, else the outermost one."""
    width = values.shape[-1]
    places = torch.arange(-beside, width + beside, device=values.device)
    return values[..., places % width if wrap else places.clamp(0, width - 1)]
