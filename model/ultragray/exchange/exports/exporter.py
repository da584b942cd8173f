"""The parts of every export: the header that its frames share, and the base of the formats."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ultragray.contract import Contract, described
from ultragray.errors import InvalidArgument
from ultragray.geometry.probe import FloatArray
from ultragray.rendering.outputs import OUTPUTS
from ultragray.rendering.pixels import PixelArray, in_type
from ultragray.rendering.settings import Contact, Encoding, Resolved, SettingsUsed, settings_used
from ultragray.scene.confidence import CONTACT_FIGURES, Extrapolation, figure_arrays

FRAME_TIME_MS = 40.0  # rendered frames have no time of their own: formats that need one show 25 a second


@dataclass(frozen=True, kw_only=True)
class Annotation(Contract):
    """Measurements and notes that a person set on a frame, as they are drawn."""

    frame: int = described("Index of its frame among the poses.", 0, low=0)
    picture: str = described(
        "A PNG file in base64 with square pixels and opacity, as wide as the frame, which it lies over from the upper "
        "left corner; what is taller stands below the frame. A finer one has the frames enlarged to its pixels."
    )
    text: str = described("The same in words, which ImageComments holds.", "")


@dataclass(frozen=True)
class ExportHeader:
    """The facts that the frames of an export share, and all it takes to render them again.

    `frame_times_ms` [C], `annotations` and `made_at` are for formats that tell them, such as DICOM.
    """

    settings: Resolved
    dtype: str  # "uint8": round(255·share of the scale), or "float32"; labels are uint8 as they are
    poses: FloatArray  # [C, 4, 4] mm
    scene: str
    scene_sha256: str
    renderer: str
    frame_times_ms: Sequence[float] | None = None  # when each frame was seen, from any beginning
    annotations: Sequence[Annotation] = ()
    made_at: datetime = field(default_factory=lambda: datetime.now(timezone.utc))

    @property
    def shape(self) -> tuple[int, int, int]:
        """[C, H, W] of each output. Raises InvalidImageSize for a huge picture."""
        return len(self.poses), self.settings.picture.height, self.settings.picture.width

    def pixel_type(self, output: str) -> np.dtype[Any]:
        return np.dtype("<u1" if OUTPUTS[output].is_numbers or self.dtype == "uint8" else "<f4")

    @property
    def settings_used(self) -> SettingsUsed:
        return settings_used(replace(self.settings, encoding=Encoding(self.dtype)))

    def origin(self) -> dict[str, Any]:
        """The origin of the frames and their settings as used, as JSON holds them."""
        made_of = {"scene": self.scene, "scene_sha256": self.scene_sha256, "renderer": self.renderer}
        return {**made_of, **self.settings_used.document()}


class Exporter(ABC):
    """Writer of one format: takes the frames in order, in portions; only `close` makes the file whole.

    Portions are arrays [B, H, W] by output, already of their pixel type (`stored_pixels`). A subclass keeps what must
    be released in `_stack`.
    """

    def __init__(self, path: Path, header: ExportHeader) -> None:
        """Open the file. Raises InvalidArgument for frames that the format cannot hold, OSError."""
        self._path, self._header, self._done = path, header, 0
        self._extrapolations: list[Extrapolation] = []  # of the frames that are there
        self._stack = ExitStack()
        self.sha256: str | None = None  # of the whole file, where a subclass has hashed it on the way
        try:
            self._open()
        except BaseException:
            self._stack.close()
            raise

    def add(self, frames: Mapping[str, PixelArray], extrapolations: Sequence[Extrapolation]) -> None:
        """The next frames, each output [B, H, W], and the extrapolation of each, [B]. Raises OSError."""
        count = len(next(iter(frames.values())))
        self._extrapolations.extend(extrapolations)
        self._write(frames, count)
        self._done += count

    def close(self) -> None:
        """Make the file whole, after the last frame. Raises OSError, InvalidArgument for fewer frames than poses."""
        try:
            if self._done != len(self._header.poses):
                raise InvalidArgument(
                    f"an export of {len(self._header.poses)} poses needs as many frames, got {self._done}",
                    field="poses",
                )
            self._finish()
        finally:
            self._stack.close()

    def abandon(self) -> None:
        """Release the file, which is worth nothing; instead of `close`, where the frames end too early."""
        with suppress(Exception):  # on a full disk, closing fails as writing did
            self._stack.close()

    def _figures(self) -> dict[str, npt.NDArray[np.float32]]:
        """The figures of all frames by name, [C]; NaN where one is not known, or the frame is still to come."""
        missing = len(self._header.poses) - len(self._extrapolations)
        contact = self._header.settings.contact
        judged = CONTACT_FIGURES if contact is Contact.PRESSURE else CONTACT_FIGURES[: contact is not None]
        unknown = Extrapolation(None, None, None, None, **dict.fromkeys(judged, math.nan))
        return figure_arrays([*self._extrapolations, *[unknown] * missing])

    @abstractmethod
    def _open(self) -> None:
        """Make the file."""

    @abstractmethod
    def _write(self, frames: Mapping[str, PixelArray], count: int) -> None:
        """Write frames `_done` to `_done` + count; their extrapolations are in `_extrapolations` already."""

    def _finish(self) -> None:
        return


def stored_pixels(output: str, frames: PixelArray, stored: np.dtype[Any]) -> PixelArray:  # [B, H, W] -> [B, H, W]
    """Rendered frames of an output as they are stored, C order."""
    return in_type(OUTPUTS[output].shares(frames) if stored == np.uint8 else frames, stored)
