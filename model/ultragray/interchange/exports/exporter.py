"""What every export is made of: the header that its frames share, and the base of the formats."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from ...confidence import Extrapolation, figure_arrays
from ...errors import InvalidArgument
from ...probe import FloatArray, Probe, probe_to_dict
from ...request import LABELS

PixelArray: TypeAlias = npt.NDArray[Any]  # uint8 or float32
FRAME_TIME_MS = 40.0  # rendered frames have no time of their own: formats that need one show 25 a second


@dataclass(frozen=True)
class ExportHeader:
    """What the frames of an export have in common, and all it takes to render them again."""

    outputs: tuple[str, ...]
    dtype: str  # "uint8": round(255·x), or "float32"; labels are uint8 as they are
    poses: FloatArray  # [C, 4, 4] mm
    height: int
    width: int
    probe: Probe
    scene: str
    scene_sha256: str
    renderer: str

    def pixel_type(self, output: str) -> np.dtype[Any]:
        """What the pixels of an output are stored as."""
        return np.dtype("<u1" if output == LABELS or self.dtype == "uint8" else "<f4")

    def origin(self) -> dict[str, Any]:
        """What says where the frames come from, as JSON holds it."""
        return {
            "scene": self.scene,
            "scene_sha256": self.scene_sha256,
            "renderer": self.renderer,
            "probe": probe_to_dict(self.probe),
        }


class Exporter(ABC):
    """Takes the frames in order, in portions; nothing but `close` makes the file whole.

    Portions are arrays [B, H, W] by output, already of their pixel type (`stored_pixels`). A subclass keeps what must
    be released in `_held`.
    """

    def __init__(self, path: Path, header: ExportHeader) -> None:
        """Raises InvalidArgument for frames that the format cannot hold, OSError."""
        self._path, self._header, self._done = path, header, 0
        self._extrapolations: list[Extrapolation] = []  # of the frames that are there
        self._held = ExitStack()
        try:
            self._open()
        except BaseException:
            self._held.close()
            raise

    def add(self, frames: Mapping[str, PixelArray], extrapolations: Sequence[Extrapolation]) -> None:
        """The next frames, each output [B, H, W], and what is told of each, [B]. Raises OSError."""
        count = len(next(iter(frames.values())))
        self._extrapolations.extend(extrapolations)
        self._write(frames, count)
        self._done += count

    def close(self) -> None:
        """After the last frame. Raises OSError, and InvalidArgument where fewer frames came than poses were told."""
        try:
            if self._done != len(self._header.poses):
                raise InvalidArgument(
                    f"an export of {len(self._header.poses)} poses needs as many frames, got {self._done}",
                    field="poses",
                )
            self._finish()
        finally:
            self._held.close()

    def abandon(self) -> None:
        """Instead of `close`, where the frames end too early: releases the file, which is worth nothing."""
        with suppress(Exception):  # on a full disk, closing fails as writing did
            self._held.close()

    def _figures(self) -> dict[str, npt.NDArray[np.float32]]:
        """The figures of all frames by name, [C]; NaN where one is not known, or the frame is still to come."""
        missing = len(self._header.poses) - len(self._extrapolations)
        return figure_arrays([*self._extrapolations, *[Extrapolation(None, None, None, None)] * missing])

    @abstractmethod
    def _open(self) -> None:
        """Makes the file."""

    @abstractmethod
    def _write(self, frames: Mapping[str, PixelArray], count: int) -> None:
        """Frames `_done` to `_done` + count; what is told of them is in `_extrapolations` already."""

    def _finish(self) -> None:
        """What comes after the last frame."""
        return


def stored_pixels(frames: PixelArray, stored: np.dtype[Any]) -> PixelArray:  # [B, H, W] -> [B, H, W]
    """Rendered frames in [0, 1] (or labels, uint8) as they are stored, C order: round(255·min(x, 1)), half to even."""
    if stored == np.uint8 and frames.dtype != np.uint8:
        rows = frames.reshape(-1, frames.shape[-1])
        return cv2.convertScaleAbs(rows, alpha=255.0).astype(np.uint8, copy=False).reshape(frames.shape)
    return np.ascontiguousarray(frames, stored)
