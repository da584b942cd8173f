"""What is put into the planes of frames after the backend has drawn them, before outputs are derived: tools, then the
second echo. Both are the same on every backend; gradients pass to the planes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool1d

from ultragray.geometry.probe import Probe
from ultragray.rendering.tools import Crossing, ScanView, Tool

PULSE_SIGMA_MM = 0.15  # of the echo of a surface along the line
HEAD_ON_SIGMA_DEG = 20.0  # by which the mirror's share of an echo falls off with the angle
LEAST = 1.0 / 255.0  # what is below it is not seen
LABELLED = 0.25  # the share of a pixel that a tool has to fill: a thin needle leaves no gaps
_LEAST_BEAM = 1e-6


class ToolsInView:
    """Tools before the scan lines of a view, in the order in which they are drawn."""

    def __init__(self, tools: Sequence[Tool], view: ScanView) -> None:
        self._tools, self._view = tools, view
        self._marks: list[_Drawn] = []

    def draw(self, planes: dict[str, Tensor], height: int, like: Tensor) -> None:
        """Draws them into planes [C, H, W] by name, B-mode only beside transmittance: it stays E·T.

        `like` has the device and the type of the planes, of which there may be none: the labels are known then.
        """
        marks = (_Drawn.of(tool, self._view, height, like) for tool in self._tools)
        self._marks = [one for one in marks if one is not None]
        for one in self._marks:
            one.draw(planes)

    def mark(self, labels: Tensor) -> None:
        """Puts their labels into labels [C, H, W], where they are; that of the last one where they meet."""
        for one in self._marks:
            labels[:, :, one.columns].masked_fill_(one.labelled, one.label)


@dataclass(frozen=True, eq=False)
class _Drawn:
    """What a tool is to the pixels of the columns that it touches: each [C, H, w]."""

    label: int
    columns: slice
    labelled: Tensor  # bool: whether its body is there
    body: Tensor  # share of the tissue's echo that gives way to it
    echo: Tensor  # that of its surface, by this share
    passed: Tensor  # share of the beam that it lets through
    tail: Tensor  # share of the beam before it that comes back later

    @classmethod
    def of(cls, tool: Tool, view: ScanView, height: int, like: Tensor) -> _Drawn | None:
        """The tool in frames of a height; None where no line meets it."""
        crossing = tool.crossing(view)
        met = np.flatnonzero(crossing.cover.max(axis=(0, 1), initial=0.0) >= LEAST)
        if not met.size:
            return None
        columns = slice(int(met[0]), int(met[-1]) + 1)
        depth = torch.as_tensor(view.probe.depths_mm(height)).to(like)[:, None]  # [H, 1]
        half_row = 0.5 * view.probe.scan_line_length_mm / height
        shape = (5, len(view.poses), height, columns.stop - columns.start)
        own, body, echo, stopped, tail = torch.zeros(shape, dtype=like.dtype, device=like.device)
        for layer in range(len(crossing.cover)):
            cover, first, last, way, own_first, own_last, path, slant, stops = (
                torch.as_tensor(getattr(crossing, one.name)[layer, :, None, columns]).to(like)  # [C, 1, w]
                for one in fields(Crossing)
            )
            top, bottom = first - half_row, last + half_row
            mirrored = _mirrored(tool, slant)
            surface = _pulse(_beyond(depth, top, bottom))
            own += cover * (_beyond(depth, torch.minimum(own_first, top), torch.maximum(own_last, bottom)) == 0.0)
            body += cover * _pulse(_beyond(depth, top, bottom + way))
            echo += cover * (tool.brightness * tool.roughness + mirrored) * surface
            stopped += cover * -torch.expm1(torch.log1p(-stops) * ((depth - last) / path).clamp(0.0, 1.0))
            if tool.reverberation:
                number = ((depth - 0.5 * (top + bottom)) / tool.thickness_mm).round().clamp(min=1.0)
                later = _beyond(depth - number * tool.thickness_mm, top, bottom)
                tail += cover * mirrored * _pulse(later, number * math.log(tool.reverberation))
        return cls(
            label=tool.label,
            columns=columns,
            labelled=own >= LABELLED,
            body=body.clamp(max=1.0),
            echo=echo.clamp(max=1.0),
            passed=(1.0 - stopped).clamp(0.0, 1.0),
            tail=tail.clamp(max=1.0),
        )

    def draw(self, planes: dict[str, Tensor]) -> None:
        """Draws it into planes [C, H, W]; gradients pass to them.

        Of the beam T before it a share `passed` goes on through the tissue behind it, and of what is then heard a share
        `tail` is the tool once more: T' = T·((1 − tail)·passed + tail), and E' is the mean of both echoes by their
        beams.
        """
        before = {name: plane[:, :, self.columns] for name, plane in planes.items()}
        through = (1.0 - self.tail) * self.passed
        heard = through + self.tail
        if "bmode" in before:
            surface = (1.0 - self.body) * before["bmode"] + self.echo * before["transmittance"]
            self._put(planes, "bmode", through * surface + self.tail * before["transmittance"])
        if "echo" in before:
            surface = (1.0 - self.body) * before["echo"] + self.echo
            self._put(planes, "echo", (through * surface + self.tail) / heard.clamp(min=_LEAST_BEAM))
        if "transmittance" in before:
            self._put(planes, "transmittance", before["transmittance"] * heard)
        if "coverage" in before:
            self._put(planes, "coverage", torch.maximum(before["coverage"], self.body))

    def _put(self, planes: dict[str, Tensor], name: str, part: Tensor) -> None:
        plane = planes[name]
        before, after = plane[:, :, : self.columns.start], plane[:, :, self.columns.stop :]
        planes[name] = torch.cat([before, part, after], dim=2)


def _beyond(depth: Tensor, first: Tensor, last: Tensor) -> Tensor:  # [H, 1], [C, 1, w] -> [C, H, w]
    return torch.maximum(first - depth, depth - last).clamp(min=0.0)


def _pulse(beyond: Tensor, log_strength: Tensor | float = 0.0) -> Tensor:  # [...] -> [...]
    """The echo of a surface at a distance from it."""
    return torch.exp(log_strength - (0.5 / PULSE_SIGMA_MM**2) * beyond * beyond)


def _mirrored(tool: Tool, slant: Tensor) -> Tensor:  # [...] -> [...]
    """The echo of a surface as of a mirror, by the sine of the angle at which it is met."""
    angle_deg = torch.rad2deg(torch.asin(slant))
    return tool.brightness * (1.0 - tool.roughness) * torch.exp(-0.5 * (angle_deg / HEAD_ON_SIGMA_DEG) ** 2)


STRONG_BMODE = 0.6  # of an interface that mirrors
LEAST_DEPTH_MM = 5.0  # below the face, whose own bright lines mirror nothing
SMOOTHED_SHARE = 0.06  # of the lines
GHOST_PLANES = ("bmode", "echo", "transmittance")
_LEAST_HEARD = 1e-6


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
    planes["echo"] = torch.where(ghosted, planes["bmode"] / heard.clamp(min=_LEAST_HEARD), planes["echo"])
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
