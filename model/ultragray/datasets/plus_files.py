"""Sequences of PLUS as files, MetaImage and NRRD: header, orientation and pixels, nothing of which is trusted.

Both formats write the fields of frame 12 as `Seq_Frame0012_NAME`. The readers are ours: pynrrd and SimpleITK inflate
whatever a header promises, and SimpleITK alone weighs 50 MB.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ultragray.datasets.images import MAX_PIXEL_BYTES, eight_bits
from ultragray.errors import DatasetInvalid
from ultragray.learn.sweep import ByteArray, frame_list

MAX_HEADER_BYTES = 256 << 20
MAX_LINE_BYTES = 1 << 20
MAX_BARE_FRAMES = 1_000  # without a field of their own: a few may lack a pose, but a frame costs memory
_ZLIB_OR_GZIP = 47  # zlib's window bits for either kind of header
_GZIP = b"\x1f\x8b"  # the beginning of a member
_FRAME_FIELD = re.compile(r"Seq_Frame(\d{1,9})_(\w+)")


@dataclass(frozen=True)
class StoredSequence:
    """F frames as stored."""

    path: Path
    pixels: ByteArray  # [F, rows, columns] or [F, rows, columns, 3]
    fields: Mapping[str, str]  # of the file
    frame_fields: tuple[Mapping[str, str], ...]  # [F]
    notes: tuple[str, ...] = ()  # what reading the pixels changed


def header_lines(file: BinaryIO, path: Path) -> Iterator[str]:
    """The lines of a text header, as far as the caller goes. Raises DatasetInvalid where they are no text."""
    total = 0
    while line := file.readline(MAX_LINE_BYTES + 1):
        total += len(line)
        if len(line) > MAX_LINE_BYTES or total > MAX_HEADER_BYTES or b"\0" in line:
            raise DatasetInvalid(f"{path}: not a sequence file: its header is no text")
        yield line.decode("utf-8", errors="replace").rstrip("\r\n")


def split_fields(
    path: Path, entries: Mapping[str, str], frame_count: int
) -> tuple[dict[str, str], tuple[Mapping[str, str], ...], tuple[str, ...]]:
    """The fields of the file, those of each of its frames, and what is to be told of fields beyond its frames.

    Raises DatasetInvalid for a number of frames far beyond those that have fields, and for frames counted from 1.
    """
    fields: dict[str, str] = {}
    frames: dict[int, dict[str, str]] = {}
    for key, value in entries.items():
        match = _FRAME_FIELD.fullmatch(key)
        if match is None:
            fields[key] = value
        else:
            frames.setdefault(int(match[1]), {})[match[2]] = value
    beyond = sorted(number for number in frames if number >= frame_count)
    if beyond and 0 not in frames:
        raise DatasetInvalid(
            f"{path}: the fields of its {frame_count} images must be counted from Seq_Frame0000, they go from "
            f"Seq_Frame{min(frames):04d} to Seq_Frame{beyond[-1]:04d}: counted from 1?"
        )
    if frame_count > len(frames) + MAX_BARE_FRAMES:
        raise DatasetInvalid(f"{path}: its header says {frame_count} frames, but has fields of {len(frames)} only")
    notes: tuple[str, ...] = ()
    if beyond:
        notes = (
            f"it has {frame_count} images, but fields of frames beyond them, which are left out: {frame_list(beyond)} "
            f"({len(beyond)} in all)",
        )
    return fields, tuple(frames.get(number, {}) for number in range(frame_count)), notes


def pixel_shape(path: Path, sizes: list[int], channels: int) -> tuple[int, ...]:  # [F, rows, columns(, channels)]
    """The shape of the pixels from the sizes of a header, fastest axis first: columns, rows, frames.

    A fourth size goes with volumes of one slice. Raises DatasetInvalid for other volumes, and where there are none.
    """
    if len(sizes) == 4 and sizes[2] == 1:
        sizes = [*sizes[:2], sizes[3]]
    if len(sizes) != 3:
        raise DatasetInvalid(f"{path}: a sequence has columns x rows x frames, got {' x '.join(map(str, sizes))}")
    if not sizes[2]:
        raise DatasetInvalid(f"{path}: it holds no frames")
    if 0 in sizes[:2]:
        raise DatasetInvalid(f"{path}: it holds no images: a recording of the tracker alone, of {sizes[2]} frames")
    if channels not in (1, 3, 4):
        raise DatasetInvalid(f"{path}: pixels must have 1, 3 or 4 channels, got {channels}")
    shape = tuple(reversed(sizes))
    return shape if channels == 1 else (*shape, channels)


def whole_numbers(path: Path, key: str, text: str) -> list[int]:
    """The whole numbers of a header's field. Raises DatasetInvalid."""
    words = text.split()
    if not words or not all(re.fullmatch(r"\d{1,12}", word) for word in words):
        raise DatasetInvalid(f"{path}: {key} must be whole numbers, got {text[:80]!r}")
    return [int(word) for word in words]


@dataclass(frozen=True)
class Payload:
    """Where the pixels of a sequence lie: in the file of the header, or in files beside it, in equal shares."""

    header: Path
    files: tuple[str, ...]  # beside the header; none: its own
    offset: int  # in each file; -1: the pixels are its end
    dtype: str  # such as u1 or >i2
    deflated: bool
    deflated_bytes: int | None = None
    lines: int = 0  # of text before the offset, in each file

    def read(self, shape: tuple[int, ...]) -> tuple[ByteArray, tuple[str, ...]]:
        """uint8 pixels of `shape`, and notes of what was changed.

        16 bits are made 8 (`eight_bits`). Raises DatasetInvalid, naming the file, where there are fewer or more bytes
        than the shape holds, the deflated bytes are damaged or values lie below 0; what is inflated never exceeds the
        shape.
        """
        paths = [_beside(self.header, name) for name in self.files] or [self.header]
        width = np.dtype(self.dtype).itemsize
        expected = width * int(np.prod([int(side) for side in shape], dtype=object))
        if not 0 < expected <= MAX_PIXEL_BYTES:
            raise DatasetInvalid(
                f"{self.header}: {' x '.join(map(str, shape))} pixels of {width} bytes, the limit is "
                f"{MAX_PIXEL_BYTES >> 30} GiB"
            )
        if expected % len(paths):
            raise DatasetInvalid(f"{self.header}: {len(paths)} files cannot hold {shape[0]} frames in equal shares")
        shares = [self._share(path, expected // len(paths)) for path in paths]
        stored = (shares[0] if len(shares) == 1 else np.concatenate(shares)).view(self.dtype).reshape(shape)
        return eight_bits(stored, str(self.header))

    def _share(self, path: Path, expected: int) -> ByteArray:
        size = path.stat().st_size
        if self.offset >= 0:
            offset = self.offset + self._after_lines(path)
        elif self.deflated and self.deflated_bytes is None:
            raise DatasetInvalid(f"{self.header}: HeaderSize -1 of compressed pixels needs CompressedDataSize")
        else:
            offset = max(0, size - (self.deflated_bytes if self.deflated and self.deflated_bytes else expected))
        if not self.deflated:
            _require_size(path, self.header, max(0, size - offset), expected)
            return np.fromfile(path, np.uint8, expected, offset=offset)
        with path.open("rb") as file:
            file.seek(offset)
            deflated_limit = expected + expected // 256 + (1 << 16)  # incompressible pixels grow by far less
            pixels = _inflate(file.read(deflated_limit), path, expected)
        _require_size(path, self.header, len(pixels), expected)
        return np.frombuffer(pixels, np.uint8)

    def _after_lines(self, path: Path) -> int:
        with path.open("rb") as file:
            for _ in range(self.lines):
                if not file.readline(MAX_LINE_BYTES).endswith(b"\n"):
                    raise DatasetInvalid(f"{path}: it does not begin with {self.lines} lines to skip")
            return file.tell()


def _inflate(data: bytes, path: Path, expected: int) -> bytes:
    """At most one byte more than is expected; of gzip every member, one after the other."""
    pixels = bytearray()
    while data:
        inflater = zlib.decompressobj(_ZLIB_OR_GZIP)
        try:
            pixels += inflater.decompress(data, expected + 1 - len(pixels))
        except zlib.error as error:
            raise DatasetInvalid(f"{path}: its compressed pixels are damaged: {error}") from error
        if not inflater.eof and len(pixels) <= expected:
            raise DatasetInvalid(
                f"{path}: truncated: its compressed pixels end after {len(pixels)} of {expected} bytes"
            )
        if len(pixels) > expected or not inflater.unused_data.startswith(_GZIP):
            break
        data = inflater.unused_data
    return bytes(pixels)


def _require_size(path: Path, header: Path, found: int, expected: int) -> None:
    if found < expected:
        raise DatasetInvalid(
            f"{path}: truncated: {found} bytes of pixels, but the header of {header.name} needs {expected}"
        )
    if found > expected:
        raise DatasetInvalid(f"{path}: more pixels than the {expected} bytes that the header of {header.name} says")


def _beside(header: Path, file_name: str) -> Path:
    if Path(file_name).name != file_name:
        raise DatasetInvalid(f"{header}: its pixels must lie beside it, it names {file_name[:200]!r}")
    path = header.parent / file_name
    if not path.is_file():
        raise DatasetInvalid(f"{header}: the file {file_name[:200]!r} with its pixels was not found beside it")
    return path


# MetaImage sequences: .mha (also .igs.mha), and .mhd with its pixels in a .raw or .zraw file.


_DTYPES = {"MET_UCHAR": "u1", "MET_UCHAR_ARRAY": "u1", "MET_USHORT": "u2", "MET_SHORT": "i2"}
_MOST_SIGNIFICANT_FIRST = ("BinaryDataByteOrderMSB", "ElementByteOrderMSB")
MAX_FILES = 100_000
MAX_SKIPPED_LINES = 10_000


def read_meta_image(path: Path) -> StoredSequence:
    """The sequence in a MetaImage file of 8 or 16 bits a pixel. Raises DatasetInvalid, naming file and reason."""
    with path.open("rb") as file:
        entries: dict[str, str] = {}
        lines = header_lines(file, path)
        for line in lines:
            key, separator, value = (part.strip() for part in line.partition("="))
            if not separator and line.strip():
                raise DatasetInvalid(f"{path}: not a MetaImage file: a line of its header is {line[:80]!r}")
            entries[key] = value
            if key == "ElementDataFile":  # by definition the last line
                break
        else:
            raise DatasetInvalid(f"{path}: not a MetaImage file, or truncated: its header has no ElementDataFile")
        files = _data_files(path, value, lines)
        offset = 0 if files else file.tell()

    def number(key: str, default: str) -> int:
        return whole_numbers(path, key, entries.get(key, default))[0]

    def flag(key: str, default: str = "False") -> bool:
        return entries.get(key, default)[:1] in ("T", "t", "1")  # as MetaIO reads it

    _check_b_mode(path, entries.get("UltrasoundImageType", ""))
    sizes = whole_numbers(path, "DimSize", entries.get("DimSize", ""))
    shape = pixel_shape(path, sizes, number("ElementNumberOfChannels", "1"))
    dtype = _DTYPES.get(entries.get("ElementType", ""))
    if dtype is None or not flag("BinaryData", "True"):
        raise DatasetInvalid(
            f"{path}: pixels must be binary {', '.join(_DTYPES)}, got ElementType "
            f"{entries.get('ElementType', 'missing')}"
        )
    fields, frame_fields, field_notes = split_fields(path, entries, shape[0])
    if entries.get("HeaderSize", "0") == "-1":
        offset = -1
    elif (header_size := number("HeaderSize", "0")) > 0:
        offset = header_size
    deflated = flag("CompressedData")
    deflated_bytes = number("CompressedDataSize", "0") or None
    order = ">" if any(map(flag, _MOST_SIGNIFICANT_FIRST)) else "<"
    pixels, notes = Payload(path, files, offset, order + dtype, deflated, deflated_bytes).read(shape)
    return StoredSequence(path, pixels, fields, frame_fields, (*field_notes, *notes))


def _data_files(path: Path, value: str, following: Iterator[str]) -> tuple[str, ...]:
    """The files that ElementDataFile names: LOCAL (none), one, LIST and one on each following line, or a pattern such
    as `frame%03d.raw 1 30 1` with its first, last and step."""
    words = value.split()
    if value.upper() == "LOCAL":
        return ()
    if words and words[0].upper() == "LIST":
        files = [line.strip() for line in islice(following, MAX_FILES) if line.strip()]
        if not files:
            raise DatasetInvalid(f"{path}: its ElementDataFile is a LIST, but no file follows")
        return tuple(files)
    pattern = re.fullmatch(r"(\S*%0?\d?d\S*)((?: \d{1,9}){2,4})", " ".join(words))
    if pattern is None:
        return (value,)
    first, last, step = (*map(int, pattern[2].split()), 1)[:3]
    return tuple(pattern[1] % number for number in islice(range(first, last + 1, max(1, step)), MAX_FILES))


def _check_b_mode(path: Path, kind: str) -> None:
    """Refuse images that are none, by the name that PLUS gives their kind: RF_REAL, RF_IQ_LINE, RF_I_LINE_Q_LINE."""
    if kind.upper() not in ("", "XX", "BRIGHTNESS", "RGB_COLOR"):
        is_rf = " (RF data, before the envelope is detected)" if kind.upper().startswith("RF") else ""
        raise DatasetInvalid(f"{path}: images must be B-mode (BRIGHTNESS or RGB_COLOR), got {kind[:40]}{is_rf}")


# NRRD sequences: .nrrd and .seq.nrrd, and .nhdr with its pixels in a file of their own; raw or gzip.


_NRRD_DTYPES = {
    **dict.fromkeys(("uchar", "unsigned char", "uint8", "uint8_t"), "u1"),
    **dict.fromkeys(("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"), "u2"),
    **dict.fromkeys(("short", "short int", "signed short", "signed short int", "int16", "int16_t"), "i2"),
}
_TYPE = "ultrasoundimagetype"
_TIME_KINDS = ("list", "time")
_COLOUR_KINDS = ("vector", "rgb-color", "rgba-color", "3-color", "4-color", "3-vector", "4-vector")


def read_nrrd(path: Path) -> StoredSequence:
    """The sequence in an NRRD file of 8 or 16 bits a pixel. Raises DatasetInvalid, naming file and reason."""
    with path.open("rb") as file:
        fields, own, listed = _read_header(file, path)
        offset = file.tell()
    _check_b_mode(path, next((value for key, value in own.items() if key.replace(" ", "").lower() == _TYPE), ""))
    counted = {int(match[1]) for key in own if (match := _FRAME_FIELD.fullmatch(key))}
    layout = _layout(path, fields, max(counted) + 1 if counted else 0)
    dtype = _NRRD_DTYPES.get(fields.get("type", "").lower())
    if dtype is None:
        raise DatasetInvalid(f"{path}: pixels must be uchar, ushort or short, got type {fields.get('type', 'missing')}")
    encoding = fields.get("encoding", "").lower()
    if encoding not in ("raw", "gzip", "gz"):
        raise DatasetInvalid(f"{path}: encoding must be raw or gzip, got {encoding or 'none'}")
    skipped = fields.get("byte skip", fields.get("byteskip", "0"))
    lines = whole_numbers(path, "line skip", fields.get("line skip", fields.get("lineskip", "0")))[0]
    if lines > MAX_SKIPPED_LINES or (skipped != "0" and encoding != "raw"):
        raise DatasetInvalid(
            f"{path}: over {MAX_SKIPPED_LINES} skipped lines, and a byte skip of compressed pixels, cannot be read"
        )
    file_fields, frame_fields, field_notes = split_fields(path, own, layout.shape[0])
    data_file = fields.get("data file", fields.get("datafile"))
    files = () if data_file is None else _data_files(path, data_file, iter(listed))
    order = ">" if fields.get("endian", "little").lower() == "big" else "<"
    begin = -1 if skipped == "-1" else (0 if files else offset) + whole_numbers(path, "byte skip", skipped)[0]
    payload = Payload(path, files, begin, order + dtype, encoding != "raw", lines=lines)
    stored, notes = payload.read(layout.stored)
    pixels = np.ascontiguousarray(stored.transpose(layout.axes)).reshape(layout.shape)
    return StoredSequence(path, pixels, file_fields, frame_fields, (*field_notes, *notes))


def _read_header(file: BinaryIO, path: Path) -> tuple[dict[str, str], dict[str, str], list[str]]:
    """The format's fields (`sizes: …`, by lower-case name), the file's own (`Seq_Frame0000_…:=…`), and the lines after
    `data file: LIST`."""
    lines = header_lines(file, path)
    if not next(lines, "").startswith("NRRD000"):
        raise DatasetInvalid(f"{path}: not an NRRD file: it does not begin with NRRD000")
    fields: dict[str, str] = {}
    own: dict[str, str] = {}
    listed: list[str] = []
    for line in lines:
        if not line:
            break
        key, separator, value = line.partition(":")
        if line.startswith("#"):
            continue
        if fields.get("data file", fields.get("datafile", "")).upper().startswith("LIST"):
            listed = [line, *islice((one for one in lines if one), MAX_FILES)]
            break
        if not separator:
            raise DatasetInvalid(f"{path}: not an NRRD file: a line of its header is {line[:80]!r}")
        if value.startswith("="):
            own[key.strip()] = value[1:].strip()
        else:
            fields[key.strip().lower()] = value.strip()
    return fields, own, listed


@dataclass(frozen=True)
class _Layout:
    stored: tuple[int, ...]  # slowest axis first
    axes: tuple[int, ...]  # of `stored`, in the order of `shape`
    shape: tuple[int, ...]  # [F, rows, columns(, channels)]


def _layout(path: Path, fields: dict[str, str], frame_fields: int) -> _Layout:
    """Which axis is that of the frames and which that of colours: by their kinds, else by the axis without a direction
    in space, else by the number of frames that have fields; else the frames are the last one."""
    sizes = whole_numbers(path, "sizes", fields.get("sizes", ""))
    kinds = fields.get("kinds", "").lower().split()
    directions = re.findall(r"none|\([^)]*\)", fields.get("space directions", "").lower())
    kinds = kinds if len(kinds) == len(sizes) else ["???"] * len(sizes)
    times = [place for place, kind in enumerate(kinds) if kind in _TIME_KINDS]
    colours = [place for place, kind in enumerate(kinds) if kind in _COLOUR_KINDS]
    if not times and colours and sizes[colours[0]] not in (1, 3, 4):  # a frame a component, as of a MultiVolume
        times, colours = colours, []
    if not times and len(directions) == len(sizes):
        times = [place for place, one in enumerate(directions) if one == "none" and place not in colours]
    if not times:
        places = [place for place in range(len(sizes)) if place not in colours]
        counted = [place for place in (*places[::-1][:1], *places[:1]) if sizes[place] == frame_fields]
        times = counted[:1] or places[-1:]
    if len(times) != 1 or len(colours) > 1:
        raise DatasetInvalid(f"{path}: one axis must be that of the frames, got kinds {fields.get('kinds', 'none')!r}")
    space = [place for place in range(len(sizes)) if place not in (*times, *colours)]
    channels = sizes[colours[0]] if colours else 1
    shape = pixel_shape(path, [*(sizes[place] for place in space), sizes[times[0]]], channels)
    last = len(sizes) - 1
    axes = tuple(last - place for place in (*times, *reversed(space), *colours))
    return _Layout(tuple(reversed(sizes)), axes, shape)


# UltrasoundImageOrientation of PLUS: where a stored image's axes point.
#
# Two letters say where the columns and then the rows of the stored image go: M or U, towards the marked or the
# unmarked side of the probe; F or N, away from the transducer (far) or towards it (near). FM: depth goes along a row.
# A third letter, A or D, is about stacks of slices and does not matter here. XX or nothing: unknown, taken as MF.


UNKNOWN = ("", "XX")


def orient_frames(frames: ByteArray, orientation: str, path: Path) -> ByteArray:
    """Stored frames [F, rows, columns] as MF: columns towards the marked side (x), rows away from the probe (z).

    PLUS calibrates, and so defines the frame `Image` of its transforms, on images brought to MF. Raises DatasetInvalid
    for an orientation that no 2D image has.
    """
    if orientation in UNKNOWN:
        return frames
    if not re.fullmatch(r"([MU][FN]|[FN][MU])[AD]?", orientation):
        raise DatasetInvalid(
            f"{path}: UltrasoundImageOrientation must be MF, MN, UF, UN, FM, NM, FU or NU, and A or D, or XX, got "
            f"{orientation[:20]!r}"
        )
    lateral, depth = orientation[0], orientation[1]
    if lateral in "FN":  # the image is transposed
        frames = np.swapaxes(frames, 1, 2)
        lateral, depth = depth, lateral
    if lateral == "U":
        frames = frames[:, :, ::-1]
    if depth == "N":
        frames = frames[:, ::-1]
    return frames
