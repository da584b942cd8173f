"""MetaImage sequences: .mha (also .igs.mha), and .mhd with its pixels in a .raw or .zraw file."""

from __future__ import annotations

from pathlib import Path

from ...errors import DatasetInvalid
from .sequence import StoredSequence, header_lines, pixel_shape, read_payload, split_fields, whole_numbers


def read_meta_image(path: Path) -> StoredSequence:
    """The sequence in a MetaImage file of 8-bit pixels. Raises DatasetInvalid, naming the file and the reason."""
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
    if entries.get("ElementType") != "MET_UCHAR" or entries.get("BinaryData", "True").lower() != "true":
        raise DatasetInvalid(
            f"{path}: pixels must be binary MET_UCHAR (8 bits), got ElementType {entries.get('ElementType', 'missing')}"
        )
    sizes = whole_numbers(path, "DimSize", entries.get("DimSize", ""))
    channels = whole_numbers(path, "ElementNumberOfChannels", entries.get("ElementNumberOfChannels", "1"))[0]
    shape = pixel_shape(path, sizes, channels)
    fields, frame_fields = split_fields(path, entries, shape[0])
    local = entries["ElementDataFile"].upper() == "LOCAL"
    header_size = whole_numbers(path, "HeaderSize", entries.get("HeaderSize", "0"))[0]
    pixels = read_payload(
        path,
        None if local else entries["ElementDataFile"],
        offset if local else header_size,
        shape,
        deflated=entries.get("CompressedData", "False").lower() == "true",
    )
    return StoredSequence(path, pixels, fields, frame_fields)
