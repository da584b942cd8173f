"""What a plan of views may be asked for, and what it tells. Free of torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from ultragray.contract import Contract, described
from ultragray.errors import InvalidArgument, InvalidProbe
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.rendering.volumes import parse_box

MAX_VIEWS = 200
MAX_LISTED = 4096  # poses that the reach may be a list of
MAX_PATH_MM = 100_000.0
WANTS = ("coverage", "confidence", "uncertainty")


@dataclass(frozen=True, kw_only=True)
class PlanSettings(Contract):
    """Which views are looked for: what they shall gain, where, and which poses are in reach.

    Without a list of poses the probe's face stays on the skin that the recorded probe faces describe, looks straight in
    or is turned by up to `tilt_deg`, `rock_deg` and `turn_deg`, to either side each, about its lateral, elevation and
    axial axis. Raises InvalidArgument, InvalidProbe.
    """

    probe: Probe | None = described("That is to scan. Default: the scene's own.", None, error=InvalidProbe)
    want: str = described(
        "What to gain. coverage: how near images come to the points, by within_mm. confidence: expected MS-SSIM of "
        "frames that show them. uncertainty: of the variance of errors that views can take away, the share they do.",
        "coverage",
        choices=WANTS,
    )
    within_mm: float = described(
        "Of coverage: a point so far from the nearest image counts half.", 1.5, above=0.0, high=50.0
    )
    region_mm: str | None = described(
        "Only points of this box count, such as -20:20,0:30,-5:45. Default: all that poses in reach show.", None
    )
    label: int | None = described("Only points with this label count.", None, low=1, high=255)
    plane: tuple[float, float, float, float] | None = described(
        "Only points of a plane count: its normal n, of any length, and the distance d, n·x = d |n|, mm.", None
    )
    views: int = described("How many at most.", 20, low=1, high=MAX_VIEWS)
    path_mm: float | None = described(
        "How long the way may be at most, from view to view that of the corners of the image on average, so that a "
        "turn counts by what it moves. Default: any length.",
        None,
        above=0.0,
        high=MAX_PATH_MM,
    )
    box_mm: str | None = described("The middle of the probe's face stays in this box. Default: anywhere.", None)
    tilt_deg: float = described("About the lateral axis.", 15.0, low=0.0, high=80.0)
    rock_deg: float = described("About the elevation axis.", 0.0, low=0.0, high=80.0)
    turn_deg: float = described("About the axial axis.", 0.0, low=0.0, high=180.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("region_mm", "box_mm"):
            if (text := getattr(self, name)) is not None:
                box_of(text, name)
        if self.plane is not None and not any(self.plane[:3]):
            raise InvalidArgument("plane must begin with a normal that is not 0", field="plane")


Box: TypeAlias = tuple[FloatArray, FloatArray]  # lower and upper corner, [3] mm


def box_of(text: str, field: str) -> Box:
    """A box in words. Raises InvalidArgument, naming the field."""
    try:
        low, high = (np.array(corner) for corner in parse_box(text))
    except InvalidArgument as error:
        raise InvalidArgument(error.detail.replace("box_mm", field, 1), field=field) from None
    if not (high > low).all():
        raise InvalidArgument(f"{field} must extend along each axis, got {text[:80]!r}", field=field)
    return low, high


@dataclass(frozen=True, eq=False)
class ViewPlan:
    """Views in the order to travel them, fewer than were asked for where no other would gain anything.

    `before` and `after` are what is wanted, by the views that the scene has and with these: shares in [0, 1], or of
    confidence an MS-SSIM. Each gain is that of its view beside those of lower ranks; they add up to the difference.
    """

    poses: FloatArray  # [K, 4, 4] mm, probe→scene
    gains: FloatArray  # [K]
    ranks: npt.NDArray[np.int64]  # [K], 0: it was chosen first
    before: float
    after: float
    path_mm: float  # of the whole way, from the start where one was given
