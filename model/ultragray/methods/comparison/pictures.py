"""Held-out frames side by side: the truth, what each method expects, and how far that is off, in one grey scale."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...datasets.sweep import Sweep
from ...display.pixels import ByteArray, image_file
from ...evaluation.scoring import Evaluation
from ...evaluation.side_by_side import DIFFERENCE_GAIN, as_picture
from ..method import FrameArray

PICTURE_PIXELS = 240
DIFFERENCE = f"|difference| x {DIFFERENCE_GAIN:g}"


@dataclass(frozen=True, eq=False)
class Shown:
    """Frames [F, H, W] in [0, 1] under a title. What is no prediction has no `evaluation`, and no difference."""

    title: str
    frames: FrameArray
    evaluation: Evaluation | None = None


@dataclass(frozen=True)
class Panel:
    """A picture, and the one of its difference, as addresses that hold the picture itself."""

    title: str
    picture: str
    difference: str | None
    note: str  # its PSNR


@dataclass(frozen=True)
class FrameOfPage:
    """A held-out frame with its panels, the truth first."""

    number: int
    kind: str  # such as "worst"; empty for frames that are evenly spread
    panels: tuple[Panel, ...]


def frames_of_page(sweep: Sweep, places: Mapping[int, str], shown: Sequence[Shown]) -> list[FrameOfPage]:
    """The frames at these places of the sweep, each named by its kind; `shown` holds the frames of the whole sweep."""
    found = []
    for place, kind in places.items():
        truth = (sweep.images[place] / 255.0).astype(np.float32)
        panels = [Panel("truth", _address(truth, sweep), None, "")]
        for one in shown:
            frame = one.frames[place]
            off = np.minimum(np.abs(frame - truth) * DIFFERENCE_GAIN, 1.0)
            panels.append(
                Panel(
                    one.title,
                    _address(frame, sweep),
                    None if one.evaluation is None else _address(off, sweep),
                    "" if one.evaluation is None else f"{one.evaluation.frames[place].psnr_db:.2f} dB",
                )
            )
        found.append(FrameOfPage(int(sweep.frame_numbers[place]), kind, tuple(panels)))
    return found


def telling_places(evaluation: Evaluation) -> dict[int, str]:
    """The frames where a method does worst, as usual, and best by PSNR; perhaps fewer than three."""
    order = np.argsort([-frame.psnr_db for frame in evaluation.frames], kind="stable")
    return {int(order[-1]): "worst", int(order[len(order) // 2]): "typical", int(order[0]): "best"}


def as_frames(stored: ByteArray) -> FrameArray:  # [F, H, W] uint8 -> in [0, 1]
    """Frames as a comparison keeps them."""
    return (stored / 255.0).astype(np.float32)


def _address(frame: FrameArray, sweep: Sweep) -> str:  # [H, W]
    picture = as_picture(frame, sweep, PICTURE_PIXELS)
    return "data:image/png;base64," + base64.b64encode(image_file(picture, ".png").tobytes()).decode()
