"""The part of a stored image that shows ultrasound, and the size and place of its pixels: for people to check."""

from __future__ import annotations

from dataclasses import dataclass

from ultragray.contract import Contract, described


@dataclass(frozen=True)
class ImageRegion(Contract):
    """Where the frames of a sequence lie in its images, brought to columns lateral and rows in depth."""

    image_width: int = described("Of the stored image, pixels.", low=1)
    image_height: int = described("Of the stored image, pixels.", low=1)
    left: int = described("Column of the stored image at which the frames begin.", low=0)
    top: int = described("Row at which they begin.", low=0)
    width: int = described("Of the frames in the stored image, pixels, before they are resized.", low=1)
    height: int = described("Likewise.", low=1)
    lateral_mm: float = described("Distance of two columns of the stored image.", above=0.0)
    axial_mm: float = described("Distance of two rows of the stored image.", above=0.0)
    image_to_probe: tuple[float, ...] = described(
        "The calibration, from pixels (column, row, 0) of the stored image to the probe's mm: 16 numbers row by row; "
        "empty where the file has none of that name.",
        (),
    )
