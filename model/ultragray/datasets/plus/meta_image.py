"""MetaImage sequences: .mha (also .igs.mha), and .mhd with its pixels in a .raw or .zraw file."""

from __future__ import annotations

from pathlib import Path

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

_DTYPES = {"MET_UCHAR": "u1", "MET_USHORT": "u2", "MET_SHORT": "i2"}
_MOST_SIGNIFICANT_FIRST = ("BinaryDataByteOrderMSB", "ElementByteOrderMSB")


def read_meta_image(path: Path) -> StoredSequence:
    """The sequence in a MetaImage file of 8 or 16 bits a pixel. Raises DatasetInvalid, naming file and reason."""
    with path.open("rb") as file:
        entries: dict[str, str] = {}
        for line in header_lines(file, path):
            key, separator, value = (part.strip() for part in line.partition("="))
            if not separator and line.strip():
                raise DatasetInvalid(f"{path}: not a MetaImage file: a line of its header is {line[:80]!r}")
            entries[key] = value
            if key == "ElementDataFile":  # by definition the last line
                break
        else:
            raise DatasetInvalid(f"{path}: not a MetaImage file, or truncated: its header has no ElementDataFile")
        offset = file.tell()
    dtype = _DTYPES.get(entries.get("ElementType", ""))
    if dtype is None or entries.get("BinaryData", "True").lower() != "true":
        raise DatasetInvalid(
            f"{path}: pixels must be binary {', '.join(_DTYPES)}, got ElementType "
            f"{entries.get('ElementType', 'missing')}"
        )
    sizes = whole_numbers(path, "DimSize", entries.get("DimSize", ""))
    channels = whole_numbers(path, "ElementNumberOfChannels", entries.get("ElementNumberOfChannels", "1"))[0]
    shape = pixel_shape(path, sizes, channels)
    fields, frame_fields = split_fields(path, entries, shape[0])
    local = entries["ElementDataFile"].upper() == "LOCAL"
    header_size = whole_numbers(path, "HeaderSize", entries.get("HeaderSize", "0"))[0]
    place = (None if local else entries["ElementDataFile"], offset if local else header_size, shape)
    deflated = entries.get("CompressedData", "False").lower() == "true"
    if dtype == "u1":
        return StoredSequence(path, read_payload(path, *place, deflated=deflated), fields, frame_fields)
    most_first = any(entries.get(key, "False").lower() == "true" for key in _MOST_SIGNIFICANT_FIRST)
    pixels, note = read_wide_payload(path, *place, (">" if most_first else "<") + dtype, deflated=deflated)
    return StoredSequence(path, pixels, fields, frame_fields, (note,))
