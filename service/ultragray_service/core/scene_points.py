"""The Gaussians of a scene as points for a 3D view: read from the file without torch."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from safetensors import SafetensorError

from ultragray.errors import InvalidArgument
from ultragray.geometry.probe import FloatArray
from ultragray.scene.info import LABELS_TENSOR, SceneInfo, read_gaussians, scene_file_invalid

FIELDS = ("x", "y", "z", "intensity", "transmittance", "deviation_mm")
SHAPE_FIELDS = ("deviation_1_mm", "deviation_2_mm", "deviation_3_mm", "qw", "qx", "qy", "qz", "label")
ALL_FIELDS = (*FIELDS, *SHAPE_FIELDS)
MAX_POINTS, DEFAULT_POINTS, MAX_POSES = 200_000, 50_000, 10_000
_SH_C0 = 0.5 / math.sqrt(math.pi)  # the harmonic of degree 0
_ALIGNMENT = 8


def point_message(path: Path, info: SceneInfo, limit: int, fields: Sequence[str] = FIELDS) -> bytes:
    """At most `limit` Gaussians, evenly taken and always the same ones, as one message.

    The length of the JSON that follows (uint32, little endian), the JSON (`count` points, their `fields`, `total`
    Gaussians), then float32 [count, F] from a multiple of 8 bytes, F the number of fields. Positions and standard
    deviations are in mm, in the scene's frame; `deviation_mm` is the mean of the three along the Gaussian's own axes,
    which the unit quaternion q turns into the scene's; intensity is that of degree 0; `label` is 0 for none.
    Raises SceneFileInvalid, InvalidArgument for a field that is not of ALL_FIELDS.
    """
    unknown = [name for name in fields if name not in ALL_FIELDS]
    if unknown or not fields:
        raise InvalidArgument(f"fields must be among {', '.join(ALL_FIELDS)}, got {list(fields)!r}", field="fields")
    columns = _columns(path, info, limit, set(fields))
    points = np.column_stack([columns[name] for name in fields])
    header = json.dumps({"count": len(points), "fields": fields, "total": info.gaussian_count}).encode()
    header += b" " * (-(4 + len(header)) % _ALIGNMENT)
    return len(header).to_bytes(4, "little") + header + points.astype("<f4").tobytes()


def even_selection(count: int, limit: int) -> npt.NDArray[np.int64]:
    """Places of at most `limit` of `count` things, in order."""
    size = min(count, limit)
    return np.arange(size) * count // max(size, 1)


def _columns(path: Path, info: SceneInfo, limit: int, wanted: set[str]) -> dict[str, FloatArray]:  # [P] each
    chosen = even_selection(info.gaussian_count, limit)
    columns: dict[str, FloatArray] = {}
    try:
        gaussians = {name: values[chosen].astype(np.float64) for name, values in read_gaussians(path, info).items()}
        means_mm = 10.0 * gaussians["means"] + np.asarray(info.centre_mm)
        deviations_mm = 10.0 * np.exp(gaussians["scales"])
        columns.update(zip("xyz", means_mm.T, strict=True), deviation_mm=deviations_mm.mean(axis=1))
        columns.update(zip(SHAPE_FIELDS[:3], deviations_mm.T, strict=True))
        value = _SH_C0 * gaussians["sh0"][:, 0, 0]
        columns["transmittance"] = _sigmoid(gaussians["transmittances"])
        if not wanted.isdisjoint(SHAPE_FIELDS[3:7]):
            quaternions = gaussians["quats"]
            unit = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
            columns.update(zip(SHAPE_FIELDS[3:7], unit.T, strict=True))
        if "label" in wanted:
            columns["label"] = gaussians[LABELS_TENSOR] if info.label_names else np.zeros(len(chosen))
    except (OSError, SafetensorError, ValueError, IndexError) as error:  # replaced since its header was read
        raise scene_file_invalid(path, error) from error
    columns["intensity"] = _sigmoid(4.0 * value) if info.intensity == "sigmoid" else np.clip(value + 1.0, 0.5, 0.999)
    return columns


def _sigmoid(values: FloatArray) -> FloatArray:
    positive: FloatArray = 0.5 * (1.0 + np.tanh(0.5 * values))
    return positive
