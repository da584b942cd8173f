"""The place of a picture's pixels in the image plane of a probe."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ultragray.contract import described
from ultragray.geometry.probe import Box, FloatArray


@dataclass(frozen=True)
class Picture:
    """The grid of a picture [H, W].

    Columns are counted in mm along x (`column_unit` "mm") or, where each is one of angular scan lines, in degrees from
    z ("deg"); rows in mm along z, or along the scan lines. Where these are steered, a column is where its line leaves
    the face. `first` is the centre of pixel (0, 0), (column, row), `step` the way to the next one, negative where the
    picture is flipped.
    """

    height: int = described("H.")
    width: int = described("W.")
    column_unit: str = described("mm or deg.", choices=("mm", "deg"))
    first: tuple[float, float] = described("Column and row of the centre of pixel (0, 0).")
    step: tuple[float, float] = described("To the next column and row.")

    @property
    def first_column(self) -> float:
        """Centre of the first pixel, in the unit of the columns."""
        return self.first[0]

    @property
    def first_row_mm(self) -> float:
        return self.first[1]

    @property
    def column_step(self) -> float:
        return self.step[0]

    @property
    def row_step_mm(self) -> float:
        return self.step[1]

    @classmethod
    def over(cls, box: Box, pixel_mm: float) -> Picture:
        """Square pixels over a box of the image plane, from its upper edge on, as many to the left as to the right."""
        columns, rows = (max(1, math.ceil(side / pixel_mm)) for side in (box.right - box.left, box.bottom - box.top))
        middle = (box.left + box.right) / 2
        return cls(
            rows, columns, "mm", (middle + (1 - columns) * pixel_mm / 2, box.top + pixel_mm / 2), (pixel_mm, pixel_mm)
        )

    def positions_mm(self) -> tuple[FloatArray, FloatArray]:  # [1, W], [H, 1]
        """Column and row of each pixel's centre, in the units of the picture."""
        columns = self.first[0] + self.step[0] * np.arange(self.width, dtype=np.float64)
        rows = self.first[1] + self.step[1] * np.arange(self.height, dtype=np.float64)
        return columns[None, :], rows[:, None]

    def flipped(self) -> Picture:
        """With left and right exchanged."""
        last = self.first[0] + (self.width - 1) * self.step[0]
        return replace(self, first=(last, self.first[1]), step=(-self.step[0], self.step[1]))
