"""PLUS sequences: a MetaImage .igs.mha whose frames have their transforms, as the recorder of a sweep writes it.

`ImageToProbe` takes pixels (column, row) to mm in the probe frame (docs/reference/frames.md), `ProbeToTracker` is the
pose; the third column of `ImageToProbe` makes it right-handed. Every frame has the status OK, times 25 a second, and
its figures as `UltraGRayConfidence` and the like, nan where one is not known.
`read_plus_sweep` gives back the same frames, those of a fan as scan lines again. Poses of a linear probe come back
moved by `near_mm` along the axial axis.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ultragray.exchange.exports.exporter import FRAME_TIME_MS, Exporter
from ultragray.geometry.probe import FloatArray
from ultragray.rendering.pixels import PixelArray

FIELDS = {
    "distance_mm": "UltraGRayDistanceMm",
    "angle_deg": "UltraGRayAngleDeg",
    "confidence": "UltraGRayConfidence",
    "supported_share": "UltraGRaySupportedShare",
    "contact_share": "UltraGRayContactShare",
    "indentation_mm": "UltraGRayIndentationMm",
    "force_n": "UltraGRayForceN",
}
FIGURE_WIDTH = 12  # of any number from 0 on, so that those found later take the place of these


class PlusExporter(Exporter):
    """A writer of the whole header at once, then of the pixels, and of the figures over their place in the header."""

    def _open(self) -> None:
        self._file = self._stack.enter_context(self._path.open("wb"))
        self._write_header()

    def _write_header(self) -> None:
        header = self._header
        figures = self._figures()
        for key, value in self._fields().items():
            self._line(key, value)
        calibration = _row_by_row(self._image_to_probe())
        for number, pose in enumerate(header.poses):
            transforms = {"ProbeToTracker": _row_by_row(pose), "ImageToProbe": calibration}
            for name, value in transforms.items():
                self._line(f"Seq_Frame{number:04d}_{name}Transform", value)
                self._line(f"Seq_Frame{number:04d}_{name}TransformStatus", "OK")
            self._line(f"Seq_Frame{number:04d}_FrameNumber", str(number))
            self._line(f"Seq_Frame{number:04d}_Timestamp", f"{number * FRAME_TIME_MS / 1000.0:.3f}")
            self._line(f"Seq_Frame{number:04d}_ImageStatus", "OK")
            for name, values in figures.items():
                self._line(f"Seq_Frame{number:04d}_{FIELDS[name]}", f"{values[number]:<{FIGURE_WIDTH}.6e}")
        self._line("ElementDataFile", "LOCAL")

    def _fields(self) -> dict[str, str]:
        header, picture = self._header, self._header.settings.picture
        return {
            "ObjectType": "Image",
            "NDims": "3",
            "BinaryData": "True",
            "BinaryDataByteOrderMSB": "False",
            "CompressedData": "False",
            "TransformMatrix": "1 0 0 0 1 0 0 0 1",
            "Offset": "0 0 0",
            "CenterOfRotation": "0 0 0",
            "AnatomicalOrientation": "RAI",
            "ElementSpacing": "1 1 1",
            "DimSize": f"{picture.width} {picture.height} {len(header.poses)}",
            "ElementType": "MET_UCHAR",
            "UltrasoundImageOrientation": "MF",
            "UltrasoundImageType": "BRIGHTNESS",
            "UltraGRayScene": " ".join(header.scene.split()),
            "UltraGRaySceneSha256": header.scene_sha256,
            "UltraGRayRenderer": header.renderer,
            **{_key(name): text for name, text in header.settings_used.texts().items()},
        }

    def _line(self, key: str, value: str) -> None:
        self._file.write(f"{key} = {value}\n".encode())

    def _image_to_probe(self) -> FloatArray:  # [4, 4] pixels -> mm
        picture = self._header.settings.picture
        matrix = np.eye(4)
        matrix[:3, 0] = picture.step[0], 0.0, 0.0
        matrix[:3, 1] = 0.0, 0.0, picture.step[1]
        matrix[:3, 2] = 0.0, -np.sign(picture.step[0]), 0.0
        matrix[:3, 3] = picture.first[0], 0.0, picture.first[1]
        return matrix

    def _write(self, frames: Mapping[str, PixelArray], count: int) -> None:
        self._file.write(frames["bmode"].data)

    def _finish(self) -> None:
        self._file.seek(0)
        self._write_header()


def _key(name: str) -> str:
    """The key of a setting: `UltraGRayGhost` of ghost."""
    return f"UltraGRay{name.title().replace('_', '')}"


def _row_by_row(matrix: FloatArray) -> str:
    return " ".join(repr(float(number)) for number in matrix.reshape(-1))
