"""How frames are shown, and where their pixels lie."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from ultragray_proto.v1 import rendering_pb2

from .errors import InvalidArgument
from .geometry import FloatArray


@dataclass(frozen=True)
class Display:
    """What a sonographer sets; the defaults show frames as they are rendered. The service checks the numbers.

    `gain_db`: added to every echo. `dynamic_range_db`: from white down to black. `tgc_db`: gains at evenly spaced
    depths from the first row shown to the last, linear in between. Those three change B-mode only; the others change
    every output: `depth_mm`: deeper rows, counted from the transducer's face, are cut off. `flip`: left and right
    change places. `pixel_mm`: scan conversion to square pixels of that size.
    """

    gain_db: float = 0.0
    dynamic_range_db: float = 60.0
    tgc_db: tuple[float, ...] = ()
    depth_mm: float | None = None
    flip: bool = False
    pixel_mm: float | None = None


@dataclass(frozen=True)
class Picture:
    """Where pixels lie in the image plane of the probe.

    Columns are mm along x (`column_unit` "mm"), or scan lines of a fan at degrees from its axis ("deg"); rows are mm
    along z, or mm of range. The first values are those of the centre of pixel (0, 0), the steps lead to the next one.
    """

    column_unit: str
    first_column: float
    first_row_mm: float
    column_step: float  # negative where left and right are exchanged
    row_step_mm: float

    def pixel_to_probe(self) -> FloatArray:  # [4, 4]
        """Takes (column, row, k, 1) to mm in the probe's frame, k in mm against the elevation y.

        Pixels are counted from 0 at their centres. Raises InvalidArgument where columns are angles.
        """
        if self.column_unit != "mm":
            raise InvalidArgument(
                f"no matrix takes pixels whose columns are in {self.column_unit} to mm; "
                "ask for square ones: display=Display(pixel_mm=...)",
                field="display.pixel_mm",
            )
        return np.array(
            [
                [self.column_step, 0.0, 0.0, self.first_column],
                [0.0, 0.0, -1.0, 0.0],
                [0.0, self.row_step_mm, 0.0, self.first_row_mm],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )


def display_message(display: Display) -> rendering_pb2.Display:
    """The service checks the numbers."""
    return rendering_pb2.Display(**asdict(display))


def display_from_message(message: rendering_pb2.Display) -> Display:
    """The settings that the service used, of which it tells all."""
    return Display(
        gain_db=message.gain_db,
        dynamic_range_db=message.dynamic_range_db,
        tgc_db=tuple(message.tgc_db),
        depth_mm=message.depth_mm if message.HasField("depth_mm") else None,
        flip=message.flip,
        pixel_mm=message.pixel_mm if message.HasField("pixel_mm") else None,
    )


def picture_from_message(message: rendering_pb2.Picture) -> Picture:
    """Where the service says that pixels lie."""
    return Picture(
        column_unit=message.column_unit,
        first_column=message.first_column,
        first_row_mm=message.first_row_mm,
        column_step=message.column_step,
        row_step_mm=message.row_step_mm,
    )
