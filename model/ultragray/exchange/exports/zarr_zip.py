"""Zarr: a group in a zip, one array [C, H, W] an output in chunks of a frame. The extra `zarr`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import zarr
from zarr.storage import ZipStore

from ultragray.exchange.exports.exporter import Exporter
from ultragray.rendering.pixels import PixelArray


class ZarrExporter(Exporter):
    """Arrays named by their output, `poses` [C, 4, 4], figures [C]; the origin is in the attributes of the group."""

    def _open(self) -> None:
        header = self._header
        store = self._stack.enter_context(ZipStore(self._path, mode="w"))
        self._group = group = zarr.create_group(store, attributes=header.origin())
        self._store_whole("poses", np.asarray(header.poses, np.float64))
        self._arrays = {
            name: group.create_array(
                name,
                shape=header.shape,
                chunks=(1, *header.shape[1:]),
                dtype=header.pixel_type(name),
                compressors=None,
                dimension_names=("frame", "depth", "line"),
                config={"write_empty_chunks": True},
            )
            for name in header.settings.outputs
        }

    def _write(self, frames: Mapping[str, PixelArray], count: int) -> None:
        for name, array in self._arrays.items():
            array[self._done : self._done + count] = frames[name]

    def _finish(self) -> None:
        for name, values in self._figures().items():
            self._store_whole(name, values)

    def _store_whole(self, name: str, values: npt.NDArray[Any]) -> None:
        self._group.create_array(
            name, shape=values.shape, chunks=values.shape, dtype=values.dtype.newbyteorder("<"), compressors=None
        )[:] = values
