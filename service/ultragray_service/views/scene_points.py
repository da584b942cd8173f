"""The Gaussians of a scene as points for a 3D view: read from the file without torch."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from safetensors import SafetensorError, safe_open

from ultragray.probe import FloatArray
from ultragray.scene_info import SceneInfo, scene_file_invalid

FIELDS = ("x", "y", "z", "intensity", "transmittance", "deviation_mm")
MAX_POINTS, DEFAULT_POINTS, MAX_POSES = 200_000, 50_000, 10_000
_SH_C0 = 0.5 / math.sqrt(math.pi)  # the harmonic of degree 0
_ALIGNMENT = 8


def point_message(path: Path, info: SceneInfo, limit: int) -> bytes:
    """At most `limit` Gaussians, evenly taken and always the same ones, as one message.

    The length of the JSON that follows (uint32, little endian), the JSON (`count` points, their `fields`, `total`
    Gaussians), then float32 [count, 6] from a multiple of 8 bytes. Positions and mean standard deviations are in mm,
    in the scene's frame; intensity is that of degree 0. Raises SceneFileInvalid.
    """
    points = _points(path, info, limit)
    header = json.dumps({"count": len(points), "fields": FIELDS, "total": info.gaussian_count}).encode()
    header += b" " * (-(4 + len(header)) % _ALIGNMENT)
    return len(header).to_bytes(4, "little") + header + points.astype("<f4").tobytes()


def even_selection(count: int, limit: int) -> npt.NDArray[np.int64]:
    """Places of at most `limit` of `count` things, in order."""
    taken = min(count, limit)
    return np.arange(taken) * count // max(taken, 1)


def _points(path: Path, info: SceneInfo, limit: int) -> FloatArray:  # [P, 6]
    chosen = even_selection(info.gaussian_count, limit)
    try:
        with safe_open(path, framework="numpy") as bundle:

            def read(name: str) -> npt.NDArray[Any]:
                return np.asarray(bundle.get_tensor(name)[chosen], np.float64)

            means_mm = 10.0 * read("means") + np.asarray(info.centre_mm)
            value = _SH_C0 * read("sh0")[:, 0, 0]
            transmittance = _sigmoid(read("transmittances"))
            deviation_mm = 10.0 * np.exp(read("scales")).mean(axis=1)
    except (OSError, SafetensorError, IndexError) as error:  # replaced since its header was read
        raise scene_file_invalid(path, error) from error
    intensity = _sigmoid(4.0 * value) if info.intensity == "sigmoid" else np.clip(value + 1.0, 0.5, 0.999)
    return np.column_stack([means_mm, intensity, transmittance, deviation_mm])


def _sigmoid(values: FloatArray) -> FloatArray:
    positive: FloatArray = 0.5 * (1.0 + np.tanh(0.5 * values))
    return positive
