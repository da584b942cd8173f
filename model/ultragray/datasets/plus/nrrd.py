"""NRRD sequences: .nrrd and .seq.nrrd, and .nhdr with its pixels in a file of their own; raw or gzip."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

from ultragray.datasets.plus.sequence import (
    StoredSequence,
    header_lines,
    pixel_shape,
    read_payload,
    read_wide_payload,
    split_fields,
    whole_numbers,
)
from ultragray.errors import DatasetInvalid

_DTYPES = {
    **dict.fromkeys(("uchar", "unsigned char", "uint8", "uint8_t"), "u1"),
    **dict.fromkeys(("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"), "u2"),
    **dict.fromkeys(("short", "short int", "signed short", "signed short int", "int16", "int16_t"), "i2"),
}
_TIME_KINDS = ("list", "time")
_COLOUR_KINDS = ("vector", "rgb-color", "rgba-color", "3-color", "4-color", "3-vector", "4-vector")


def read_nrrd(path: Path) -> StoredSequence:
    """The sequence in an NRRD file of 8 or 16 bits a pixel. Raises DatasetInvalid, naming file and reason."""
    with path.open("rb") as file:
        fields, own = _read_header(file, path)
        offset = file.tell()
    dtype = _DTYPES.get(fields.get("type", "").lower())
    if dtype is None:
        raise DatasetInvalid(f"{path}: pixels must be uchar, ushort or short, got type {fields.get('type', 'missing')}")
    encoding = fields.get("encoding", "").lower()
    if encoding not in ("raw", "gzip", "gz"):
        raise DatasetInvalid(f"{path}: encoding must be raw or gzip, got {encoding or 'none'}")
    if any(fields.get(key, "0") != "0" for key in ("line skip", "lineskip", "byte skip", "byteskip")):
        raise DatasetInvalid(f"{path}: files with a line skip or byte skip cannot be read")
    shape = _shape(path, fields)
    file_fields, frame_fields = split_fields(path, own, shape[0])
    data_file = fields.get("data file", fields.get("datafile"))
    place, deflated = (data_file, 0 if data_file else offset, shape), encoding != "raw"
    if dtype == "u1":
        return StoredSequence(path, read_payload(path, *place, deflated=deflated), file_fields, frame_fields)
    order = ">" if fields.get("endian", "little").lower() == "big" else "<"
    pixels, note = read_wide_payload(path, *place, order + dtype, deflated=deflated)
    return StoredSequence(path, pixels, file_fields, frame_fields, (note,))


def _read_header(file: BinaryIO, path: Path) -> tuple[dict[str, str], dict[str, str]]:
    """The format's fields (`sizes: …`, by lower-case name) and the file's own (`Seq_Frame0000_…:=…`)."""
    lines = header_lines(file, path)
    if not next(lines, "").startswith("NRRD000"):
        raise DatasetInvalid(f"{path}: not an NRRD file: it does not begin with NRRD000")
    fields: dict[str, str] = {}
    own: dict[str, str] = {}
    for line in lines:
        if not line:
            break
        key, separator, value = line.partition(":")
        if line.startswith("#"):
            continue
        if not separator:
            raise DatasetInvalid(f"{path}: not an NRRD file: a line of its header is {line[:80]!r}")
        if value.startswith("="):
            own[key.strip()] = value[1:].strip()
        else:
            fields[key.strip().lower()] = value.strip()
    return fields, own


def _shape(path: Path, fields: dict[str, str]) -> tuple[int, ...]:  # [F, rows, columns(, channels)]
    sizes = whole_numbers(path, "sizes", fields.get("sizes", ""))
    kinds = fields.get("kinds", "").lower().split()
    channels = 1
    if len(kinds) == len(sizes):
        if kinds[0] in _COLOUR_KINDS:
            channels, sizes, kinds = sizes[0], sizes[1:], kinds[1:]
        if any(kind in _TIME_KINDS for kind in kinds[:-1]):
            raise DatasetInvalid(f"{path}: the frames must be the last axis, got kinds {fields['kinds']!r}")
    return pixel_shape(path, sizes, channels)
