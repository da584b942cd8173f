"""An export that is small enough to be answered at once: its file as bytes."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from ultragray.confidence import Extrapolation
from ultragray.display.pixels import PixelArray
from ultragray.interchange.exports.exporter import ExportHeader, stored_pixels
from ultragray.interchange.exports.formats import exporter_class


def export_bytes(
    format: str, header: ExportHeader, frames: Mapping[str, PixelArray], extrapolations: Sequence[Extrapolation]
) -> bytes:
    """The file of a format with all frames, each output [C, H, W], and the extrapolation of each, [C].

    Raises ExtraMissing, InvalidArgument for frames that the format cannot hold, OSError.
    """
    make = exporter_class(format)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "export")
        exporter = make(path, header)
        try:
            exporter.add(
                {name: stored_pixels(frames[name], header.pixel_type(name)) for name in frames}, extrapolations
            )
        except BaseException:
            exporter.abandon()
            raise
        exporter.close()
        return path.read_bytes()
