"""The specification of a job from and to JSON, as the queue keeps it and HTTP takes it."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import Any

import numpy as np

from ultragray import contract
from ultragray.errors import InvalidArgument
from ultragray.geometry.probe import FloatArray
from ultragray.samplers import MAX_POSES
from ultragray_workers.jobs.kinds.base import Specification

_POSES, _POSE_COUNT = "poses", "pose_count"


def to_dict(specification: Specification) -> dict[str, Any]:
    """The specification in JSON; `kind` comes first. Poses are base64 of float64, row by row, the low byte first."""
    document, poses = _without_poses(specification)
    if poses is not None:
        document[_POSES] = base64.b64encode(poses.astype("<f8").tobytes()).decode("ascii")
    return document


def in_short(specification: Specification) -> dict[str, Any]:
    """As `to_dict`, but of poses only their number, as `pose_count`: what lists and views of jobs show."""
    document, poses = _without_poses(specification)
    return document if poses is None else {**document, _POSE_COUNT: len(poses)}


def from_dict(document: Mapping[str, Any]) -> Specification:
    """Inverse of `to_dict`, poses also as lists; what is left out keeps its default.

    Raises InvalidArgument, whose field is a path, also for an unknown kind.
    """
    values = dict(document)
    if isinstance(values.get(_POSES), str):
        values[_POSES] = _unpacked(values[_POSES])
    return contract.from_dict(Specification, values)


def value_in(document: Mapping[str, Any], role: str) -> str | None:
    """The dataset or scene that a job's JSON names in a role: needs_dataset, needs_scene or makes_scene."""
    field = getattr(Specification.member(document["kind"]), role)
    return None if field is None else document[field]


def has_checkpoints(document: Mapping[str, Any]) -> bool:
    """Whether a job's JSON asks for work that, interrupted, goes on from where it was."""
    return Specification.member(document["kind"]).has_checkpoints or is_in_shards(document)


def is_in_shards(document: Mapping[str, Any]) -> bool:
    """Whether a job's JSON asks for a batch, whose shards many workers make."""
    return Specification.member(document["kind"]).is_in_shards(document)


def _without_poses(specification: Specification) -> tuple[dict[str, Any], FloatArray | None]:
    names = [
        item.name for item, _ in contract.annotated_fields(type(specification)) if item.name not in ("kind", _POSES)
    ]
    values = {name: contract.to_dict(getattr(specification, name), with_none=False) for name in names}
    poses = getattr(specification, _POSES, None)
    return {"kind": specification.kind, **values}, None if poses is None else np.asarray(poses)


def _unpacked(text: str) -> FloatArray:  # [C, 4, 4] mm
    try:
        poses: FloatArray = np.frombuffer(base64.b64decode(text, validate=True), "<f8").reshape(-1, 4, 4)
    except ValueError:
        raise InvalidArgument(f"poses must be a list of 1 to {MAX_POSES} 4x4 matrices", field=_POSES) from None
    return poses
