"""Parquet in the layout of Hugging Face `datasets`: a row a frame, each output an `Image`. The extra `parquet`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import pyarrow
import pyarrow.parquet

from ultragray.exchange.exports.exporter import Exporter
from ultragray.rendering.pixels import PixelArray, png_file


class ParquetExporter(Exporter):
    """Columns `scene`, `frame`, outputs, `pose` [4][4] mm, figures; the origin, JSON, is metadata named `ultragray`."""

    def _open(self) -> None:
        matrix: dict[str, Any] = {"feature": {"feature": _value("float64"), "_type": "List"}, "_type": "List"}
        image = pyarrow.struct({"bytes": pyarrow.binary(), "path": pyarrow.string()})
        columns = {  # the type of each, in Arrow and as a feature of `datasets`
            "scene": (pyarrow.string(), _value("string")),
            "frame": (pyarrow.int64(), _value("int64")),
            **{name: (image, {"_type": "Image"}) for name in self._header.settings.outputs},
            "pose": (pyarrow.list_(pyarrow.list_(pyarrow.float64())), matrix),
            **{name: (pyarrow.float32(), _value("float32")) for name in self._figures()},
        }
        features = {name: feature for name, (_, feature) in columns.items()}
        metadata = {"huggingface": {"info": {"features": features}}, "ultragray": self._header.origin()}
        types = [(name, kind) for name, (kind, _) in columns.items()]
        self._schema = pyarrow.schema(types, {name: json.dumps(document) for name, document in metadata.items()})
        file = self._stack.enter_context(self._path.open("wb"))
        # PNG files are compressed already.
        self._writer = self._stack.enter_context(pyarrow.parquet.ParquetWriter(file, self._schema, compression="none"))

    def _write(self, frames: Mapping[str, PixelArray], count: int) -> None:
        first, header = self._done, self._header
        rows = {
            "scene": [header.scene] * count,
            "frame": range(first, first + count),
            **{
                name: [{"bytes": png_file(one), "path": None} for one in frames[name]]
                for name in header.settings.outputs
            },
            "pose": header.poses[first : first + count].tolist(),
            **{name: values[first : first + count] for name, values in self._figures().items()},
        }
        self._writer.write_table(pyarrow.Table.from_pydict(rows, self._schema))


def _value(kind: str) -> dict[str, Any]:
    return {"dtype": kind, "_type": "Value"}
