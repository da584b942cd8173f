"""Rendered frames in files that others read, written while frames come: whole or not at all.

`export_to(path, "dicom", header)` is the one way in; a format is one module behind `Exporter`, found by its name.
What a format can hold is known without importing what it needs. Free of torch.
"""

from __future__ import annotations

from ultragray.exchange.exports.exporter import Exporter, ExportHeader
from ultragray.exchange.exports.formats import (
    FORMATS,
    Format,
    Writing,
    check_format,
    export_to,
    exporter_class,
    format_of,
)

__all__ = [
    "FORMATS",
    "ExportHeader",
    "Exporter",
    "Format",
    "Writing",
    "check_format",
    "export_to",
    "exporter_class",
    "format_of",
]
