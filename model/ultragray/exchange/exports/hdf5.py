"""HDF5: one data set [C, H, W] an output in chunks of a frame. The extra `hdf5`."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from typing import Any

import h5py
import numpy as np

from ultragray.exchange.exports.exporter import Exporter
from ultragray.rendering.pixels import PixelArray


class Hdf5Exporter(Exporter):
    """Data sets named by their output, `poses` [C, 4, 4], figures [C]; the origin as attributes, objects as JSON."""

    def _open(self) -> None:
        header = self._header
        self._sink = self._stack.enter_context(_Sink(str(self._path), "r+"))
        self._hdf5 = file = self._stack.enter_context(h5py.File(self._sink, "w"))
        origin = header.origin()
        file.attrs.update({name: one if isinstance(one, str) else json.dumps(one) for name, one in origin.items()})
        file.create_dataset("poses", data=np.asarray(header.poses, np.float64))
        self._sets = {
            name: file.create_dataset(
                name,
                shape=header.shape,
                chunks=(1, *header.shape[1:]),
                dtype=header.pixel_type(name),
            )
            for name in header.settings.outputs
        }

    def _write(self, frames: Mapping[str, PixelArray], count: int) -> None:
        for name, data_set in self._sets.items():
            data_set[self._done : self._done + count] = frames[name]
        self._sink.check()

    def _finish(self) -> None:
        for name, values in self._figures().items():
            self._hdf5.create_dataset(name, data=values)

    def close(self) -> None:
        super().close()
        self._sink.check()


class _Sink(io.FileIO):
    """A file that keeps its first error for `check`: the library crashes where it cannot write what it must."""

    error: OSError | None = None

    def check(self) -> None:
        if self.error is not None:
            raise self.error

    def write(self, data: Any, /) -> int:
        rest = memoryview(data).cast("B")
        length = len(rest)
        try:
            while rest and self.error is None:
                rest = rest[super().write(rest) :]
        except OSError as error:
            self.error = error
        return length

    def truncate(self, size: int | None = None, /) -> int:
        try:
            return super().truncate(size)
        except OSError as error:
            self.error = self.error or error
            return size or 0
