"""What a job is asked to do: the typed specification, and its checked way from and to JSON."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, TypeAlias

import numpy as np

from ultragray.contract import checked_number, under
from ultragray.contract import from_dict as from_json
from ultragray.contract import to_dict as to_json
from ultragray.errors import InvalidArgument
from ultragray.image_size import check_image_size
from ultragray.interchange.exports import check_format
from ultragray.outputs import check_outputs
from ultragray.pose import check_poses
from ultragray.probe import FloatArray
from ultragray.samplers import MAX_POSES, Sampler, TrainingSampler
from ultragray.training.config import PRESETS, TrainingConfig

from ..scenes import check_scene_name

_MAX_SETTINGS, _MAX_SETTING_CHARACTERS = 100, 100
_SHOWN_NAME_CHARACTERS = 64
_DEVICE = re.compile(r"auto|cpu|cuda(:\d{1,3})?")

Poses: TypeAlias = FloatArray | list[list[list[float]]]  # [C, 4, 4] mm


@dataclass(frozen=True)
class TrainJob:
    """A dataset becomes a scene that is served. `settings`: fields of TrainingConfig instead of the preset's.

    Raises InvalidArgument, also for a preset or a setting that no training has, and for a value outside its range.
    """

    dataset: str
    scene: str  # name that the scene is served under
    preset: str = "fast"
    settings: dict[str, Any] = field(default_factory=dict)
    device: str = "auto"  # the worker's

    kind = "train"

    def __post_init__(self) -> None:
        _require(isinstance(self.dataset, str) and self.dataset != "", "dataset", "the name of a dataset", self.dataset)
        check_scene_name(self.scene)
        _require(
            isinstance(self.preset, str) and self.preset in PRESETS,
            "preset",
            f"one of {', '.join(PRESETS)}",
            self.preset,
        )
        is_object = isinstance(self.settings, dict) and len(self.settings) <= _MAX_SETTINGS
        _require(is_object, "settings", f"an object of at most {_MAX_SETTINGS} training settings", self.settings)
        _check_settings(self.preset, self.settings)
        is_device = isinstance(self.device, str) and _DEVICE.fullmatch(self.device) is not None
        _require(is_device, "device", "auto, cpu, cuda or cuda:N", self.device)


@dataclass(frozen=True, eq=False)
class RenderJob:
    """Frames of a scene become one archive, at `poses`, or at those that `sampler` makes.

    The sampler makes them of `poses`, or where none are given of the scene's training poses. Poses are kept as an array
    of exact ones: up to 100,000 of them would be millions of Python's objects. A sampler keeps to poses that have
    `min_confidence`; `poses` without a sampler must all have it. Raises InvalidArgument, InvalidPose, InvalidImageSize,
    UnknownOutput.
    """

    scene: str
    poses: Poses | None = None  # [C, 4, 4] mm
    sampler: Sampler | None = None
    height: int | None = None  # None: as trained, else 512
    width: int | None = None
    outputs: tuple[str, ...] = ("bmode",)
    format: str = "npz"
    dtype: str | None = None  # "uint8" or "float32"; None: the format's own
    min_confidence: float | None = None  # 0 to 1; None: any

    kind = "render"

    def __post_init__(self) -> None:
        check_scene_name(self.scene)
        if self.poses is None and self.sampler is None:
            raise InvalidArgument("poses or sampler must be given", field="poses")
        if self.poses is not None and isinstance(self.sampler, TrainingSampler):
            raise InvalidArgument("poses must be left out where sampler is of kind training", field="poses")
        if self.poses is not None:
            is_many = isinstance(self.poses, (list, np.ndarray))
            length = len(self.poses) if is_many else self.poses
            is_right = is_many and 1 <= len(self.poses) <= MAX_POSES
            _require(is_right, "poses", f"a list of 1 to {MAX_POSES} 4x4 matrices", length)
            object.__setattr__(self, "poses", check_poses(self.poses))
        check_image_size(1 if self.height is None else self.height, 1)
        check_image_size(1, 1 if self.width is None else self.width)
        is_names = isinstance(self.outputs, (list, tuple)) and all(isinstance(name, str) for name in self.outputs)
        _require(is_names, "outputs", "a list of outputs", self.outputs)
        object.__setattr__(self, "outputs", check_outputs(self.outputs))
        check_format(self.format, self.outputs, self.dtype)
        if self.min_confidence is not None:
            with under("min_confidence"):
                share = checked_number(self.min_confidence, float, low=0.0, high=1.0)
            object.__setattr__(self, "min_confidence", share)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RenderJob) and to_dict(self) == to_dict(other)

    __hash__ = None  # type: ignore[assignment]


Specification: TypeAlias = TrainJob | RenderJob
_KINDS: dict[str, type[TrainJob] | type[RenderJob]] = {one.kind: one for one in (TrainJob, RenderJob)}


def to_dict(specification: Specification) -> dict[str, Any]:
    """What JSON holds of it; `kind` comes first. Poses are base64 of float64, row by row, the low byte first."""
    document = _without_poses(specification)
    if (poses := _poses(specification)) is not None:
        document["poses"] = base64.b64encode(poses.astype("<f8").tobytes()).decode("ascii")
    return document


def from_dict(document: Mapping[str, Any]) -> Specification:
    """Inverse of `to_dict`, poses also as lists; what is left out keeps its default.

    Raises InvalidArgument, whose field is a path.
    """
    values = dict(document)
    kind = values.pop("kind", None)
    _require(isinstance(kind, str) and kind in _KINDS, "kind", f"one of {', '.join(_KINDS)}", kind)
    sampler = values.get("sampler")
    if kind == RenderJob.kind and sampler is not None:
        values["sampler"] = _sampler(sampler)
    if kind == RenderJob.kind and isinstance(values.get("poses"), str):
        values["poses"] = _unpacked(values["poses"])
    made = _make(_KINDS[kind], values)
    assert isinstance(made, (TrainJob, RenderJob))
    return made


def in_short(specification: Specification) -> dict[str, Any]:
    """As `to_dict`, but of poses only their number, as `pose_count`: what lists and views of jobs show."""
    document, poses = _without_poses(specification), _poses(specification)
    return document if poses is None else {**document, "pose_count": len(poses)}


def digest(specification: Specification, priority: int) -> str:
    """Tells two submissions apart: SHA-256, hexadecimal, of everything that was asked for."""
    document = {"specification": in_short(specification), "priority": priority}
    asked = hashlib.sha256(json.dumps(document, sort_keys=True).encode())
    if (poses := _poses(specification)) is not None:
        asked.update(poses.astype("<f8").tobytes())
    return asked.hexdigest()


def _poses(specification: Specification) -> FloatArray | None:  # [C, 4, 4] mm
    poses = getattr(specification, "poses", None)
    return None if poses is None else np.asarray(poses)


def _without_poses(specification: Specification) -> dict[str, Any]:
    names = [item.name for item in fields(specification) if item.name != "poses"]
    values = {name: getattr(specification, name) for name in names}
    if isinstance(specification, RenderJob):
        values["outputs"] = list(specification.outputs)
        values["sampler"] = None if specification.sampler is None else to_json(specification.sampler, with_none=False)
    return {"kind": specification.kind, **values}


def _unpacked(text: str) -> FloatArray:  # [C, 4, 4] mm
    try:
        poses: FloatArray = np.frombuffer(base64.b64decode(text, validate=True), "<f8").reshape(-1, 4, 4)
    except ValueError:
        raise InvalidArgument(f"poses must be a list of 1 to {MAX_POSES} 4x4 matrices", field="poses") from None
    return poses


def _check_settings(preset: str, settings: dict[str, Any]) -> None:
    for name, value in settings.items():
        short = len(name) <= _MAX_SETTING_CHARACTERS
        _require(short, "settings", f"names of at most {_MAX_SETTING_CHARACTERS} characters", name)
        is_plain = value is None or isinstance(value, (bool, int, float, str))
        short = is_plain and len(str(value)) <= _MAX_SETTING_CHARACTERS
        _require(short, f"settings.{name}", "a number, a word, true, false or null", value)
    try:
        TrainingConfig.preset(preset, **settings)
    except InvalidArgument as error:
        raise InvalidArgument(error.detail, field=f"settings.{error.field}") from None


def _sampler(document: Any) -> Sampler:
    with under("sampler"):
        return from_json(Sampler, document)


def _make(cls: type[Any], values: dict[str, Any]) -> Any:
    known = {item.name for item in fields(cls)}
    for name in values:
        shown = str(name)[:_SHOWN_NAME_CHARACTERS]
        _require(name in known, shown, f"left out: known are {', '.join(sorted(known))}", values[name])
    for item in fields(cls):
        if item.name not in values and item.name in ("dataset", "scene"):
            raise InvalidArgument(f"{item.name} is required", field=item.name)
    return cls(**values)


def _require(holds: bool, name: str, expected: str, given: Any) -> None:
    if not holds:
        told = repr(given)
        told = told if len(told) <= 100 else f"{told[:100]}…"
        raise InvalidArgument(f"{name} must be {expected}, got {told}", field=name)
