"""Held-out frames side by side: the truth, what each method expects, and how far that is off, in one grey scale."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ultragray.learn.evaluation.scoring import Evaluation
from ultragray.learn.evaluation.side_by_side import DIFFERENCE_GAIN, as_picture
from ultragray.learn.sweep import Sweep
from ultragray.rendering.pixels import ByteArray, image_file
from ultragray_studies.methods.method import FrameArray

PICTURE_PIXELS = 240


@dataclass(frozen=True, eq=False)
class Shown:
    """Frames [F, H, W] in [0, 1] under a title. What is no prediction has no PSNR, and no difference."""

    title: str
    frames: FrameArray
    psnr_db: Sequence[float] | None = None  # of each frame

    @classmethod
    def prediction(cls, title: str, stored: ByteArray, evaluation: Evaluation, places: Sequence[int]) -> Shown:
        """Of all frames [F, H, W] that a method expects, as a comparison keeps them, those at these places."""
        frames = (stored[list(places)] / 255.0).astype(np.float32)
        return cls(title, frames, [evaluation.frames[place].psnr_db for place in places])


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


def frames_of_page(chosen: Sweep, kinds: Sequence[str], shown: Sequence[Shown]) -> list[FrameOfPage]:
    """Each frame of the chosen ones with its kind; all of `shown` hold as many frames."""
    found = []
    for row, kind in enumerate(kinds):
        truth = (chosen.images[row] / 255.0).astype(np.float32)
        panels = [Panel("truth", _address(truth, chosen), None, "")]
        for one in shown:
            frame = one.frames[row]
            difference, note = None, ""
            if one.psnr_db is not None:
                difference = _address(np.minimum(np.abs(frame - truth) * DIFFERENCE_GAIN, 1.0), chosen)
                note = f"{one.psnr_db[row]:.2f} dB"
            panels.append(Panel(one.title, _address(frame, chosen), difference, note))
        found.append(FrameOfPage(int(chosen.frame_numbers[row]), kind, tuple(panels)))
    return found


def telling_places(evaluation: Evaluation) -> dict[int, str]:
    """The frames where a method does worst, as usual, and best by PSNR; perhaps fewer than three."""
    order = np.argsort([-frame.psnr_db for frame in evaluation.frames], kind="stable")
    return {int(order[-1]): "worst", int(order[len(order) // 2]): "typical", int(order[0]): "best"}


def _address(frame: FrameArray, sweep: Sweep) -> str:  # [H, W]
    picture = as_picture(frame, sweep, PICTURE_PIXELS)
    return "data:image/png;base64," + base64.b64encode(image_file(picture, ".png").tobytes()).decode()
