"""The named transforms of a PLUS sequence and its device set: `ProbeToTracker` maps points of Probe to Tracker.

p_Tracker = ProbeToTracker · p_Probe, [4, 4], mm; coordinates of `Image` are pixels.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from ultragray.errors import DatasetInvalid
from ultragray.probe import FloatArray

MAX_DEVICE_SET_BYTES = 8 << 20
_NAME = re.compile(r"([A-Z]\w*?)To([A-Z]\w*)")

TransformName = tuple[str, str]  # from, to


def transform_name(text: str) -> TransformName | None:
    """("Probe", "Tracker") of `ProbeToTracker`; None for another word."""
    match = _NAME.fullmatch(text)
    return None if match is None else (match[1], match[2])


def parse_matrix(text: str, where: str) -> FloatArray:  # [4, 4]
    """Sixteen numbers, row by row, the last row 0 0 0 1. Raises DatasetInvalid, naming `where`."""
    try:
        matrix = np.array([float(word) for word in text.split()])
    except ValueError:
        raise DatasetInvalid(f"{where} must be sixteen numbers, got {text[:80]!r}") from None
    if matrix.size != 16 or not np.isfinite(matrix).all():
        raise DatasetInvalid(f"{where} must be sixteen finite numbers, got {text[:80]!r}")
    matrix = matrix.reshape(4, 4)
    if np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-6 or abs(np.linalg.det(matrix[:3, :3])) < 1e-12:
        raise DatasetInvalid(f"{where} must be invertible and end in the row 0 0 0 1, got {text[:200]!r}")
    return matrix


@dataclass(frozen=True)
class DeviceSet:
    """A PLUS device set (XML)."""

    path: Path
    root: ElementTree.Element
    transforms: Mapping[TransformName, FloatArray]  # under CoordinateDefinitions


def read_device_set(path: Path) -> DeviceSet:
    """Raises DatasetInvalid, naming the file, where it cannot be read or holds no transforms."""
    if not path.is_file():
        raise DatasetInvalid(f"{path}: no such file")
    if path.stat().st_size > MAX_DEVICE_SET_BYTES:
        raise DatasetInvalid(f"{path}: too large for a device set: over {MAX_DEVICE_SET_BYTES >> 20} MiB")
    data = path.read_bytes()
    if b"<!DOCTYPE" in data:  # PLUS writes none; the entities that it could define grow without bounds
        raise DatasetInvalid(f"{path}: a device set has no DOCTYPE")
    try:
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise DatasetInvalid(f"{path}: not XML that can be read: {error}") from error
    transforms = {}
    for element in root.iterfind(".//CoordinateDefinitions/Transform"):
        origin, target, matrix = (element.get(key, "") for key in ("From", "To", "Matrix"))
        if origin and target:
            transforms[origin, target] = parse_matrix(matrix, f"{path}: {origin}To{target}")
    if not transforms:
        raise DatasetInvalid(f"{path}: it has no Transform under CoordinateDefinitions")
    return DeviceSet(path, root, transforms)


def find_path(names: Iterable[TransformName], start: str, goal: str) -> list[tuple[TransformName, bool]] | None:
    """The fewest transforms that lead from `start` to `goal`, in order; True where one is inverted. None: no way."""
    steps: dict[str, list[tuple[str, TransformName, bool]]] = {}
    for origin, target in sorted(set(names)):
        steps.setdefault(origin, []).append((target, (origin, target), False))
        steps.setdefault(target, []).append((origin, (origin, target), True))
    ways: dict[str, list[tuple[TransformName, bool]]] = {start: []}
    reached = [start]
    for place in reached:
        for target, name, inverted in steps.get(place, ()):
            if target not in ways:
                ways[target] = [*ways[place], (name, inverted)]
                reached.append(target)
    return ways.get(goal)
