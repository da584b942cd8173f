"""The speckle of a sweep's frames, as the scene's file describes it. No torch.

`ultragray.learn.training.speckle` fits it, `ultragray.rendering.speckle` draws from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ultragray.contract import Contract, described
from ultragray.errors import InvalidArgument

BANDS = 4  # of depth, equally long, from the first row to the last
LEVELS = 9  # grey levels at which the strength is known, from 0 to 1
SMALLEST_MM, LARGEST_MM = 1e-3, 100.0


def _widths(meaning: str) -> Any:
    return described(meaning, low=SMALLEST_MM, high=LARGEST_MM)


@dataclass(frozen=True)
class SpeckleModel(Contract):
    """Scatterers fixed in the tissue, and the point-spread function that they are seen through (docs/physics.md §9).

    Widths are standard deviations of an echo's amplitude, in the middle of each band of depth.
    Raises InvalidArgument.
    """

    seed: int = described("Of the scatterers.", low=0, high=2**32 - 1)
    axial_mm: tuple[float, ...] = _widths("Width along scan lines, by depth.")
    lateral_mm: tuple[float, ...] = _widths("Width across scan lines, by depth.")
    elevation_mm: tuple[float, ...] = _widths("Width across the image plane, by depth.")
    cell_mm: tuple[float, float, float] = _widths("Lateral, elevation and axial size of what scatters as one.")
    strength: tuple[float, ...] = described(
        "Deviation of the speckle's grey values, by that of B-mode.", low=0.0, high=1.0
    )
    wavenumber_per_mm: float = described("Phase of an echo by its way there and back; 0: none.", 0.0, low=0.0, high=1e3)
    looks: float = described("Independent images whose power a frame shows.", 1.0, low=1.0, high=2.0)
    floor: float = described(
        "Power added before the logarithm, in units of the speckle's: noise.", 0.0, low=0.0, high=1e4
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, count in (("axial_mm", BANDS), ("lateral_mm", BANDS), ("elevation_mm", BANDS), ("strength", LEVELS)):
            if len(getattr(self, name)) != count:
                raise InvalidArgument(f"{name} must be {count} numbers, got {len(getattr(self, name))}", field=name)
