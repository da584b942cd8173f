"""WebDataset: a tar with some files of one name for each frame."""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Mapping

import numpy as np

from ultragray.exchange.exports.exporter import Exporter
from ultragray.rendering.pixels import PixelArray, image_file


class TarExporter(Exporter):
    """A writer of 000012.OUTPUT.png (float32: .npy) for each output and 000012.json (pose, figures, origin)."""

    def _open(self) -> None:
        self._tar = self._held.enter_context(tarfile.TarFile(self._path, "w"))

    def _write(self, frames: Mapping[str, PixelArray], count: int) -> None:
        for place in range(count):
            number = self._done + place
            for name in self._header.settings.outputs:
                frame = frames[name][place]
                suffix, data = (
                    ("png", image_file(frame, ".png").tobytes()) if frame.dtype == np.uint8 else ("npy", _npy(frame))
                )
                self._member(f"{number:06d}.{name}.{suffix}", data)
            figures = self._extrapolations[number].figures()
            document = {"pose": self._header.poses[number].tolist(), **figures, **self._header.origin()}
            self._member(f"{number:06d}.json", json.dumps(document).encode())

    def _member(self, name: str, data: bytes) -> None:
        member = tarfile.TarInfo(name)
        member.size = len(data)
        self._tar.addfile(member, io.BytesIO(data))


def _npy(frame: PixelArray) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array(file, frame, allow_pickle=False)
    return file.getvalue()


