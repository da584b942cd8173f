"""The Gaussians of a compressed scene file (.ugz), in parts of a few bytes for each, the largest ones first.

The file is the bundle of a scene file in which the tensors part.00, part.01, … (uint8) hold the Gaussians; a reader
that has only the first of them has a coarser scene. docs/reference/scene-file.md gives the layout byte by byte.

What a step may be follows from what it changes in frames. A Gaussian that is moved by a share of its thickness, or
whose scale or turn changes, alters the pixels that it covers: of a large one there are more, so its steps are finer.
A turn matters as far as the axes that it mixes differ in length: its step is halved at each of RATIOS.
"""

from __future__ import annotations

import itertools
import math
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ultragray.files import require_version

COMPRESSED_SUFFIX = ".ugz"
COMPRESSED_TENSOR = "compressed"  # uint8 [8]: the version of the format, and the checksum of all but the parts
COMPRESSED_FORMAT = 1
MAX_PARTS = 100  # two digits

_SHARES = (0.1, 0.2, 0.3, 0.4)  # of the Gaussians in each part
_FEWEST = 4096  # in parts: fewer are not worth a second table
# Steps of what is stored, of Gaussians of median volume; measured on trained scenes (make compressed).
_MEAN_STEPS = 64  # in the median of the smallest standard deviations
_SCALE_STEP, _TURN_STEP, _SH0_STEP, _SHN_STEP, _LOGIT_STEP = 0.013, 0.024, 0.03, 2.0**-6, 0.5
_FINER = 0.25  # power of the volume
_LOGITS = (-8.0, 12.0)  # beyond which a transmittance is 0, or 1, to what a frame shows
RATIOS = (0.12, 0.35, 0.75, 1.35, 2.0, 2.7, 3.4, 4.1)  # logarithms of the ratio of two axes
_CELL_BITS = 7  # of each coordinate: the cells of a part are numbered along a Morton curve

_HEAD = struct.Struct("<II")  # Gaussians, and bits of a coordinate within its cell
_COLUMN = np.dtype([("low", "<f8"), ("step", "<f8"), ("planes", "u1")])
_CRC = struct.Struct("<I")
_MOST_PLANES, _MOST_BITS = 4, 32
_OTHERS = np.array([1, 2, 0]), np.array([2, 0, 1])  # the axes that a turn about each axis mixes

Floats = npt.NDArray[np.float32]
Doubles = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


def checked_tensor(description: str, *poses: npt.NDArray[Any] | None) -> bytes:
    """What COMPRESSED_TENSOR holds for a scene's description and its poses, as they stand in the file."""
    checksum = zlib.crc32(description.encode())
    for one in poses:
        checksum = zlib.crc32(b"" if one is None else np.ascontiguousarray(one).tobytes(), checksum)
    return _HEAD.pack(COMPRESSED_FORMAT, checksum)


def check_tensor(data: bytes, description: str, *poses: npt.NDArray[Any] | None) -> None:
    """Raises ValueError where what COMPRESSED_TENSOR holds is of another version, or of other bytes."""
    expected = checked_tensor(description, *poses)
    if len(data) == len(expected):
        require_version(_HEAD.unpack(data)[0], COMPRESSED_FORMAT)
    if data != expected:
        raise ValueError("its description or its poses are damaged: their checksum differs")


def part_name(index: int) -> str:
    """Of a tensor."""
    return f"part.{index:02}"


def column_names(sh_degree: int, has_labels: bool) -> list[str]:
    """What a part tells of each Gaussian, in its order."""
    rest = [f"shN_{k}" for k in range((sh_degree + 1) ** 2 - 1)]
    axes = [f"{of}_{axis}" for of in ("mean", "scale", "turn") for axis in "xyz"]
    return ["cell", *axes, "transmittance", "sh0", *rest, *(["label"] if has_labels else [])]


# Encoding


def pack(splats: Mapping[str, Floats], labels: npt.NDArray[np.uint8] | None) -> list[bytes]:
    """The parts that hold raw parameters [N, ...] and labels [N], N at least 1."""
    turns, scales = _least_turned(splats["quats"], splats["scales"])
    volumes = scales.sum(axis=1)
    order = np.argsort(-volumes, kind="stable")
    ends = np.cumsum(_SHARES if len(order) >= _FEWEST else (1.0,)) * len(order)
    mean_step = float(np.exp(np.median(scales.min(axis=1)))) / _MEAN_STEPS
    parts = []
    for chosen in np.split(order, ends[:-1].astype(int)):
        factor = math.exp(-_FINER * (np.median(volumes[chosen]) - np.median(volumes)))
        chosen, cells, rest_bits, columns = _placed(splats["means"], chosen, mean_step)
        table = [(0.0, 1.0, cells), *columns]
        table += [_steps(column, factor * _SCALE_STEP) for column in scales[chosen].T]
        decoded = np.stack([_values(*column) for column in table[-3:]], axis=1)
        table += [_steps(column, factor * _TURN_STEP) for column in (turns[chosen] * _fineness(decoded)).T]
        table += [_steps(np.clip(splats["transmittances"][chosen], *_LOGITS), _LOGIT_STEP)]
        table += [_steps(splats["sh0"][chosen, 0, 0], factor * _SH0_STEP)]
        table += [_steps(column, _SHN_STEP) for column in splats["shN"][chosen, :, 0].T]
        if labels is not None:
            table += [(0.0, 1.0, labels[chosen].astype(np.int64))]
        parts.append(_part(table, rest_bits))
    return parts


def _least_turned(quats: Floats, scales: Floats) -> tuple[Doubles, Doubles]:  # [N, 4], [N, 3] -> [N, 3] both
    """Turns r (the quaternion is 1, r, but for its norm) and log scales of the same ellipsoids.

    An ellipsoid is the same after any of the 24 turns that bring a cube into itself, with its scales exchanged: of
    these the least turned one is taken, so that no |r| exceeds √2 − 1 by axis.
    """
    unit = quats.astype(np.float64)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    best, turns, exchanged = np.full(len(unit), -1.0), np.zeros((len(unit), 3)), np.zeros((len(unit), 3), np.int64)
    for turn in _turns_of_a_cube():
        w, x, y, z = unit.T
        a, b, c, d = turn
        w, x, y, z = (
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        )
        better = np.abs(w) > best
        best[better] = np.abs(w)[better]
        turns[better] = (np.stack([x, y, z], axis=1)[better]) / w[better, None]
        exchanged[better] = _axes_after(turn)
    return turns, np.take_along_axis(scales.astype(np.float64), exchanged, axis=1)


def _turns_of_a_cube() -> Iterator[tuple[float, ...]]:
    """24 unit quaternions: of 1, 2 or 4 components of equal size, each once, whatever its sign."""
    for one in itertools.product((-1, 0, 1), repeat=4):
        count = sum(map(abs, one))
        if count in (1, 2, 4) and next(filter(None, one)) > 0:
            yield tuple(component / math.sqrt(count) for component in one)


def _axes_after(turn: tuple[float, ...]) -> list[int]:
    """Which axis each of the three becomes."""
    w, *v = turn
    across = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    matrix = (w * w - np.dot(v, v)) * np.eye(3) + 2 * np.outer(v, v) + 2 * w * across
    axes: list[int] = np.abs(matrix).argmax(axis=0).tolist()
    return axes


def _placed(
    means: Floats, chosen: Integers, step: float
) -> tuple[Integers, Integers, int, list[tuple[float, float, Integers]]]:
    """Gaussians in the order of their cells; each cell less the one before; bits, and columns, of what is left."""
    lows = means[chosen].astype(np.float64).min(axis=0)
    places = np.round((means[chosen] - lows) / step).astype(np.int64)
    rest_bits = max(int(places.max()).bit_length() - _CELL_BITS, 0)
    cells = np.zeros(len(places), np.int64)
    for bit, axis in itertools.product(range(_CELL_BITS), range(3)):
        cells |= (places[:, axis] >> (rest_bits + bit) & 1) << (3 * bit + axis)
    order = np.argsort(cells, kind="stable")
    rest = places[order] & ((1 << rest_bits) - 1)
    columns = [(float(low), step, column) for low, column in zip(lows, rest.T, strict=True)]
    return chosen[order], np.diff(cells[order], prepend=0), rest_bits, columns


def _steps(values: npt.NDArray[Any], step: float) -> tuple[float, float, Integers]:
    """Values as a least one and multiples of a step above it."""
    numbers = np.round(values / step).astype(np.int64)
    least = int(numbers.min())
    return least * step, step, numbers - least


def _part(table: Sequence[tuple[float, float, Integers]], rest_bits: int) -> bytes:
    """Head, table, the planes of bytes of all columns, deflated, and a checksum."""
    rows = np.array([(low, step, -(-int(numbers.max()).bit_length() // 8)) for low, step, numbers in table], _COLUMN)
    deflate = zlib.compressobj(9, zlib.DEFLATED, -15, 9)
    planes = b""
    for row, (_, _, numbers) in zip(rows, table, strict=True):
        for plane in reversed(range(row["planes"])):
            planes += deflate.compress((numbers >> 8 * plane & 255).astype(np.uint8).tobytes())
            planes += deflate.flush(zlib.Z_BLOCK)  # each has a code of its own
    part = _HEAD.pack(len(table[0][2]), rest_bits) + rows.tobytes() + planes + deflate.flush()
    return part + _CRC.pack(zlib.crc32(part))


# Decoding: each value in float64, then rounded to float32, as model/library/compressed.cpp does to the bit.


def unpack(parts: Sequence[bytes], count: int, sh_degree: int, has_labels: bool) -> dict[str, npt.NDArray[Any]]:
    """Raw parameters [N, ...], and labels [N], of N = `count` Gaussians. Raises ValueError where a part is damaged."""
    names = column_names(sh_degree, has_labels)
    rest, unpacked = count, []
    for index, part in enumerate(parts):
        unpacked.append(_unpacked(part, names, rest, f"its {part_name(index)}"))
        rest -= len(unpacked[-1]["means"])
    if rest:
        raise ValueError(f"its parts hold {count - rest} Gaussians, its description says {count}")
    return {name: np.concatenate([one[name] for one in unpacked]) for name in unpacked[0]}


def _unpacked(part: bytes, names: Sequence[str], most: int, called: str) -> dict[str, npt.NDArray[Any]]:
    table_end = _HEAD.size + len(names) * _COLUMN.itemsize
    if len(part) < table_end + _CRC.size or _CRC.unpack(part[-_CRC.size :])[0] != zlib.crc32(part[: -_CRC.size]):
        raise ValueError(f"{called} is damaged: its checksum differs")
    count, rest_bits = _HEAD.unpack_from(part)
    rows = np.frombuffer(part, _COLUMN, len(names), _HEAD.size)
    size = int(count * rows["planes"].sum(dtype=np.int64))
    if not 0 < count <= most or rest_bits > _MOST_BITS or rows["planes"].max() > _MOST_PLANES:
        raise ValueError(f"{called} has a head that it cannot have")
    inflate = zlib.decompressobj(-15)
    try:
        data = inflate.decompress(part[table_end : -_CRC.size], size + 1)
    except zlib.error:
        data = b""
    if len(data) != size or not inflate.eof:
        raise ValueError(f"{called} is not of the size that its head says")
    planes = iter(np.frombuffer(data, np.uint8).reshape(-1, count) if size else ())
    columns = {}
    for name, row in zip(names, rows, strict=True):
        numbers = np.zeros(count, np.int64)
        for _ in range(row["planes"]):
            numbers = numbers << 8 | next(planes)
        columns[name] = float(row["low"]), float(row["step"]), numbers

    cells = np.cumsum(columns["cell"][2])
    means = []
    for axis, name in enumerate(("mean_x", "mean_y", "mean_z")):
        low, step, places = columns[name]
        for bit in range(_CELL_BITS):
            places = places | (cells >> (3 * bit + axis) & 1) << (rest_bits + bit)
        means.append(_values(low, step, places))
    scales = np.stack([_values(*columns[f"scale_{axis}"]) for axis in "xyz"], axis=1)
    fine = _fineness(scales)
    turns = [_doubles(*columns[f"turn_{axis}"]) / fine[:, k] for k, axis in enumerate("xyz")]
    rest = [_values(*columns[name]) for name in names if name.startswith("shN")]
    return {
        "means": np.stack(means, axis=1),
        "scales": scales,
        "quats": np.stack([np.ones(count), *turns], axis=1).astype(np.float32),
        "transmittances": _values(*columns["transmittance"]),
        "sh0": _values(*columns["sh0"])[:, None, None],
        "shN": np.array(rest, np.float32).reshape(len(rest), count).T[..., None],
        **({"labels": columns["label"][2].astype(np.uint8)} if "label" in columns else {}),
    }


def _doubles(low: float, step: float, numbers: Integers) -> Doubles:
    with np.errstate(all="ignore"):  # of a damaged table: from_splats refuses what comes of it
        return low + step * numbers.astype(np.float64)


def _values(low: float, step: float, numbers: Integers) -> Floats:
    with np.errstate(all="ignore"):
        return _doubles(low, step, numbers).astype(np.float32)


def _fineness(scales: Floats) -> Doubles:  # [N, 3] log -> [N, 3]
    """2^k for each axis: by how much its turn is finer than between axes of equal length."""
    with np.errstate(all="ignore"):
        apart = np.abs(scales[:, _OTHERS[0]].astype(np.float64) - scales[:, _OTHERS[1]])
    return np.exp2(np.searchsorted(RATIOS, apart).astype(np.float64))
