"""The linear array."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from ultragray.contract import kind_field
from ultragray.probe.probe import Probe, length_field, odd_length
from ultragray.probe.scan_lines import ParallelLines

USUAL_WIDTHS_MM = (5.0, 200.0)


@dataclass(frozen=True)
class LinearProbe(Probe):
    """A linear array: parallel scan lines along +z, the face centred on the origin."""

    width_mm: float = length_field("Width of the face.", above=0.0, example=40.0)
    near_mm: float = length_field("Depth at which the image begins.", example=0.0)
    far_mm: float = length_field("Depth at which the image ends, beyond `near_mm`.", above=0.0, example=50.0)
    kind: Literal["linear"] = kind_field("linear")

    face_depth_mm = 0.0

    @property
    def lines(self) -> ParallelLines:
        return ParallelLines(self.width_mm)

    def oddities(self) -> Iterator[str]:
        if not USUAL_WIDTHS_MM[0] <= self.width_mm <= USUAL_WIDTHS_MM[1]:
            yield odd_length("image is", "wide", self.width_mm, USUAL_WIDTHS_MM)
        yield from super().oddities()
