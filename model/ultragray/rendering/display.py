"""Settings of a scanner's display: gain, dynamic range, time-gain compensation, depth, flip, scan conversion.

Free of torch: doors take them. `show` of `ultragray.rendering.frames` applies them, after the outputs are derived.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ultragray.contract import Contract, described
from ultragray.errors import InvalidArgument, InvalidImageSize
from ultragray.geometry.image_size import MAX_IMAGE_SIDE
from ultragray.geometry.probe import FloatArray, Picture, Probe, length_field

FRAME_RANGE_DB = 60.0  # a B-mode frame is taken as compressed logarithmically over this range, 1 being 0 dB
MAX_TGC_POINTS = 16


@dataclass(frozen=True)
class Display(Contract):
    """Settings of a display. The defaults show frames as they are.

    Gain, dynamic range, time-gain compensation and edge enhancement change B-mode only; the others change every output.
    Raises InvalidArgument for numbers beyond the limits.
    """

    __topic__ = "Display"
    gain_db: float = described("Added to every echo.", 0.0, low=-100.0, high=100.0)
    dynamic_range_db: float = described("From white down to black.", FRAME_RANGE_DB, low=1.0, high=200.0)
    tgc_db: tuple[float, ...] = described(
        "Gains at evenly spaced depths from the first row shown to the last, linear in between.",
        (),
        low=-100.0,
        high=100.0,
        most=MAX_TGC_POINTS,
    )
    depth_mm: float | None = length_field("Deeper rows, counted from the face, are cut off.", default=None, low=1e-3)
    flip: bool = described("Left and right change places.", False)
    pixel_mm: float | None = described("Scan conversion to square pixels of this size.", None, low=1e-3, high=100.0)
    edge: float = described(
        "Edge enhancement: how much of what a blur over 3x3 samples takes away is added.", 0.0, low=0.0, high=4.0
    )
    gain_db_between: tuple[float, ...] = described(
        "Two numbers between which the gain of each frame is drawn at random, instead of gain_db.",
        (),
        low=-100.0,
        high=100.0,
        most=2,
    )
    dynamic_range_db_between: tuple[float, ...] = described(
        "Two numbers between which the dynamic range of each frame is drawn at random, instead of dynamic_range_db.",
        (),
        low=1.0,
        high=200.0,
        most=2,
    )
    display_seed: int = described(
        "Of what is drawn at random: the same seed and pose are the same frame, at every door.", 0, low=0, high=2**53
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in _DRAWN:
            between = getattr(self, f"{name}_between")
            if between and (len(between) != 2 or between[0] > between[1]):
                raise InvalidArgument(
                    f"{name}_between must be two numbers, the lower one first, got {list(between)}",
                    field=f"{name}_between",
                )

    @property
    def varies(self) -> bool:
        """Whether frames of different poses are shown differently."""
        return any(getattr(self, f"{name}_between") for name in _DRAWN)

    def of_frame(self, pose: FloatArray) -> Display:  # [4, 4] mm
        """The settings of the frame of a pose, with what is drawn at random: uniform, from a hash of seed and pose.

        So nothing depends on which frames are rendered beside it, nor in which order.
        """
        state = self.display_seed
        for word in (pose[:3] + 0.0).astype("<f8").view("<u8").ravel().tolist():
            state = _mixed(state ^ word)
        settled: dict[str, Any] = {f"{name}_between": () for name in _DRAWN}
        for name in _DRAWN:
            state = _mixed(state)
            share = (state >> 11) / 2**53
            if between := getattr(self, f"{name}_between"):
                settled[name] = float(between[0] + share * (between[1] - between[0]))
        return replace(self, **settled)

    @property
    def changes_tone(self) -> bool:
        return self.gain_db != 0.0 or self.dynamic_range_db != FRAME_RANGE_DB or any(self.tgc_db)

    def rows_shown(self, probe: Probe, height: int) -> int:
        if self.depth_mm is None:
            return height
        share = (probe.face_depth_mm + self.depth_mm - probe.near_mm) / probe.scan_line_length_mm
        return max(1, round(height * min(share, 1.0)))

    def picture(self, probe: Probe, height: int, width: int) -> Picture:
        """Size and place of what frames of height x width are shown as. Raises InvalidImageSize for a huge one."""
        rows = self.rows_shown(probe, height)
        cropped = probe.cropped(rows / height)
        picture = cropped.frame_picture(rows, width) if self.pixel_mm is None else cropped.picture(self.pixel_mm)
        if max(picture.height, picture.width) > MAX_IMAGE_SIDE:
            raise InvalidImageSize(
                f"a picture may have at most {MAX_IMAGE_SIDE} pixels on a side, pixels of {self.pixel_mm:g} mm make it "
                f"{picture.height}x{picture.width}",
                field="pixel_mm",
            )
        return picture.flipped() if self.flip else picture

    def gains(self, rows: int) -> FloatArray:  # [rows]
        gains = np.full(rows, self.gain_db)
        if self.tgc_db:
            points = np.linspace(0.0, 1.0, len(self.tgc_db))
            gains += np.interp((np.arange(rows) + 0.5) / rows, points, self.tgc_db)
        return gains


_DRAWN = ("gain_db", "dynamic_range_db")  # fields that have one of the same name and `_between`
AS_RENDERED = Display()


def true_to_scale(probe: Probe, height: int, max_side: int = MAX_IMAGE_SIDE) -> Display:
    """Shows frames with one size of a pixel: as they are where they are true to scale, else scan-converted.

    Pixels are then as large as a depth sample, or larger where a side would have more than `max_side` of them.
    """
    if probe.is_true_to_scale:
        return AS_RENDERED
    return Display(pixel_mm=max(probe.scan_line_length_mm / height, probe.box_mm.longer_side / (max_side - 1)))


def _mixed(word: int) -> int:
    """A step of SplitMix64 (G. Steele et al. 2014): 64 bits, each of which depends on all of a word."""
    word = (word + 0x9E3779B97F4A7C15) % 2**64
    word = (word ^ word >> 30) * 0xBF58476D1CE4E5B9 % 2**64
    word = (word ^ word >> 27) * 0x94D049BB133111EB % 2**64
    return word ^ word >> 31
