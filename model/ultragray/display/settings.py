"""What a sonographer sets on a scanner: gain, dynamic range, time-gain compensation, depth, flip, scan conversion.

Free of torch; `show` in `ultragray.display.frames` applies it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..errors import InvalidArgument, InvalidImageSize
from ..probe import FloatArray, LinearProbe, Picture, Probe
from ..request import MAX_IMAGE_SIDE

FRAME_RANGE_DB = 60.0  # a B-mode frame is taken as compressed logarithmically over this range, 1 being 0 dB
MAX_GAIN_DB = 100.0
DYNAMIC_RANGE_DB = (1.0, 200.0)
MAX_TGC_POINTS = 16
MAX_PIXEL_MM = 100.0


@dataclass(frozen=True)
class Display:
    """How frames are shown. The defaults show them as they are.

    `gain_db`: added to every echo. `dynamic_range_db`: from white down to black. `tgc_db`: gains at evenly spaced
    depths from the first row shown to the last, linear in between. Those three change B-mode only; the others change
    every output: `depth_mm`: deeper rows, counted from the transducer's face, are cut off. `flip`: left and right
    change places. `pixel_mm`: scan conversion to square pixels of that size.

    Raises InvalidArgument for numbers beyond the limits of this module.
    """

    gain_db: float = 0.0
    dynamic_range_db: float = FRAME_RANGE_DB
    tgc_db: tuple[float, ...] = ()
    depth_mm: float | None = None
    flip: bool = False
    pixel_mm: float | None = None

    def __post_init__(self) -> None:
        _check("gain_db", self.gain_db, -MAX_GAIN_DB, MAX_GAIN_DB)
        _check("dynamic_range_db", self.dynamic_range_db, *DYNAMIC_RANGE_DB)
        if len(self.tgc_db) > MAX_TGC_POINTS:
            raise InvalidArgument(
                f"tgc_db must hold at most {MAX_TGC_POINTS} gains, got {len(self.tgc_db)}", field="tgc_db"
            )
        for index, gain in enumerate(self.tgc_db):
            _check(f"tgc_db[{index}]", gain, -MAX_GAIN_DB, MAX_GAIN_DB)
        if self.depth_mm is not None:
            _check("depth_mm", self.depth_mm, 1e-3, math.inf)
        if self.pixel_mm is not None:
            _check("pixel_mm", self.pixel_mm, 1e-3, MAX_PIXEL_MM)

    @property
    def changes_tone(self) -> bool:
        """Whether B-mode values are changed."""
        return self.gain_db != 0.0 or self.dynamic_range_db != FRAME_RANGE_DB or any(self.tgc_db)

    def rows_shown(self, probe: Probe, height: int) -> int:
        """How many of H rows are not cut off, at least one."""
        if self.depth_mm is None:
            return height
        face_mm = 0.0 if isinstance(probe, LinearProbe) else probe.near_mm
        share = (face_mm + self.depth_mm - probe.near_mm) / probe.scan_line_length_mm
        return min(height, max(1, round(height * share)))

    def picture(self, probe: Probe, height: int, width: int) -> Picture:
        """Size and place of what frames of height x width are shown as. Raises InvalidImageSize for a huge one."""
        rows = self.rows_shown(probe, height)
        shown = probe.cropped(rows / height)
        picture = shown.frame_picture(rows, width) if self.pixel_mm is None else shown.picture(self.pixel_mm)
        if max(picture.height, picture.width) > MAX_IMAGE_SIDE:
            raise InvalidImageSize(
                f"a picture may have at most {MAX_IMAGE_SIDE} pixels on a side, pixels of {self.pixel_mm:g} mm make it "
                f"{picture.height}x{picture.width}",
                field="pixel_mm",
            )
        return picture.flipped() if self.flip else picture

    def gains(self, rows: int) -> FloatArray:  # [rows]
        """What is added to each row shown, in dB."""
        gains = np.full(rows, self.gain_db)
        if self.tgc_db:
            points = np.linspace(0.0, 1.0, len(self.tgc_db))
            gains += np.interp((np.arange(rows) + 0.5) / rows, points, self.tgc_db)
        return gains


def _check(field: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise InvalidArgument(f"{field} must be from {low:g} to {high:g}, got {value:g}", field=field)


AS_RENDERED = Display()


def true_to_scale(probe: Probe, height: int, max_side: int = MAX_IMAGE_SIDE) -> Display:
    """Shows frames with one size of a pixel: those of a linear probe as they are, fans scan-converted.

    Pixels of a fan are as large as a depth sample, or larger where a side would have more than `max_side` of them.
    """
    if isinstance(probe, LinearProbe):
        return AS_RENDERED
    corners = probe.corners_mm()
    sides_mm = corners.max(axis=0) - corners.min(axis=0)
    return Display(pixel_mm=max(probe.scan_line_length_mm / height, float(sides_mm.max()) / (max_side - 1)))
