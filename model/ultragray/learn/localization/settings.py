"""What a search for a frame may be told, and what it tells. Free of torch."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from ultragray.contract import Contract, described
from ultragray.errors import InvalidProbe
from ultragray.geometry.probe import FloatArray, Probe

NEAR_MM, NEAR_DEG = 3.0, 5.0
MOST_MM, MOST_DEG = 20.0, 30.0


class SearchKind(str, Enum):
    """How much is known of where a frame was taken."""

    NEAR = "near"
    TRACK = "track"
    ANYWHERE = "anywhere"


@dataclass(frozen=True, kw_only=True)
class LocalizationSettings(Contract):
    """How a real frame is looked for in a scene. Raises InvalidArgument, InvalidProbe."""

    probe: Probe | None = described("That took the frame. Default: the scene's own.", None, error=InvalidProbe)
    within_mm: float = described(
        f"How far the start may be off; more than {NEAR_MM:g} costs more time.", NEAR_MM, above=0.0, high=MOST_MM
    )
    within_deg: float = described(
        f"By which angle; more than {NEAR_DEG:g} costs more time.", NEAR_DEG, above=0.0, high=MOST_DEG
    )
    search: SearchKind = described(
        "near: about the start. track: the start is the pose of the frame before, a millimetre or two away; a tenth of "
        "the time. anywhere: nothing is known, and the start counts for nothing; the first search of a scene takes "
        "seconds more.",
        SearchKind.NEAR,
    )


@dataclass(frozen=True, eq=False)
class Localization:
    """Where a frame was taken, and how certain that is.

    `similarity` is the correlation of the frame's structures with the scene's, from -1 to 1; `is_found` says whether it
    is as high as only the right place has it. The standard deviations follow from how much the image changes with the
    pose, and from what is left unexplained; they hold where `is_found` does.
    """

    pose: FloatArray  # [4, 4] mm, probe→scene
    similarity: float
    is_found: bool
    position_std_mm: tuple[float, float, float]  # along the probe's lateral, elevation and axial axis
    angle_std_deg: tuple[float, float, float]  # about them, through the middle of the image
    shift_mm: float  # of the middle of the image from the start
    turn_deg: float
