"""NumPy archives: one array [C, H, W] an output, stored without compression; objects of the origin as JSON."""

from __future__ import annotations

import json
import shutil
import tempfile
import zipfile
from collections.abc import Mapping
from typing import IO

import numpy as np

from ultragray.exchange.exports.exporter import Exporter
from ultragray.rendering.pixels import PixelArray


class NpzExporter(Exporter):
    """A writer of the first output into the archive as it comes; the others wait in files without a name beside it."""

    def _open(self) -> None:
        header = self._header
        self._archive = self._held.enter_context(zipfile.ZipFile(self._path, "w"))
        first, *others = header.settings.outputs
        self._waiting = {name: self._held.enter_context(self._nameless()) for name in others}
        self._first = self._held.enter_context(self._member(first))
        self._files: dict[str, IO[bytes]] = {first: self._first, **self._waiting}
        for name, file in self._files.items():
            described = {"descr": header.pixel_type(name).str, "fortran_order": False, "shape": header.shape}
            np.lib.format.write_array_header_1_0(file, described)

    def _nameless(self) -> IO[bytes]:
        return tempfile.TemporaryFile(dir=self._path.parent)

    def _member(self, name: str) -> IO[bytes]:
        return self._archive.open(f"{name}.npy", "w", force_zip64=True)

    def _write(self, frames: Mapping[str, PixelArray], count: int) -> None:
        for name, file in self._files.items():
            file.write(frames[name].data)

    def _finish(self) -> None:
        self._first.close()
        for name, file in self._waiting.items():
            file.seek(0)
            with self._member(name) as member:
                shutil.copyfileobj(file, member, 1 << 20)
        header = self._header
        origin = {name: one if isinstance(one, str) else json.dumps(one) for name, one in header.origin().items()}
        described = {"poses": np.asarray(header.poses, np.float64), **self._figures(), **origin}
        for name, value in described.items():
            with self._member(name) as member:
                np.lib.format.write_array(member, np.asarray(value), allow_pickle=False)


