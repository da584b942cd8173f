"""What a job is asked to do: the typed specification, and its checked way from and to JSON."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal, TypeAlias

from ultragray.errors import InvalidArgument
from ultragray.pose import check_poses
from ultragray.request import check_image_size, check_outputs

from ..scenes import check_scene_name

PRESETS = ("fast", "paper")
FORMATS = ("npz", "tar")
SAMPLERS = ("jitter", "training")
MAX_FRAMES = 100_000  # of one render job
MAX_TRANSLATION_MM, MAX_ROTATION_DEG = 1000.0, 180.0
MAX_SEED = 2**63 - 1
_MAX_SETTINGS = 100
_DEVICE = re.compile(r"auto|cpu|cuda(:\d{1,3})?")

Poses: TypeAlias = list[list[list[float]]]  # [C, 4, 4] mm


@dataclass(frozen=True)
class TrainJob:
    """A dataset becomes a scene that is served. `settings`: fields of TrainingConfig instead of the preset's.

    The settings are checked by the training itself: only it knows their ranges. Raises InvalidArgument.
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
        _require(self.preset in PRESETS, "preset", f"one of {', '.join(PRESETS)}", self.preset)
        is_object = isinstance(self.settings, dict) and len(self.settings) <= _MAX_SETTINGS
        _require(is_object, "settings", f"an object of at most {_MAX_SETTINGS} training settings", self.settings)
        for name, value in self.settings.items():
            is_plain = value is None or isinstance(value, (bool, int, str)) or _is_finite(value)
            _require(is_plain, f"settings.{name}", "a finite number, a word, true, false or null", value)
        is_device = isinstance(self.device, str) and _DEVICE.fullmatch(self.device) is not None
        _require(is_device, "device", "auto, cpu, cuda or cuda:N", self.device)


@dataclass(frozen=True)
class PoseSampler:
    """Poses made from the scene's training poses: those themselves (`training`), or random ones near them (`jitter`).

    Jitter takes a random training pose, turns it about a random axis through the probe's origin and shifts it: angle
    and each axis of the shift are normal, with these standard deviations. Raises InvalidArgument.
    """

    kind: str
    count: int | None = None
    translation_mm: float = 0.0
    rotation_deg: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        _require(self.kind in SAMPLERS, "kind", f"one of {', '.join(SAMPLERS)}", self.kind)
        if self.kind == "training":
            is_bare = self.count is None and not (self.translation_mm or self.rotation_deg or self.seed)
            _require(is_bare, "kind", "jitter where count, translation_mm, rotation_deg or seed is given", self.kind)
        else:
            _require(_is_integer(self.count, 1, MAX_FRAMES), "count", f"an integer from 1 to {MAX_FRAMES}", self.count)
        for name, limit in (("translation_mm", MAX_TRANSLATION_MM), ("rotation_deg", MAX_ROTATION_DEG)):
            value = getattr(self, name)
            _require(_is_finite(value) and 0 <= value <= limit, name, f"between 0 and {limit:g}", value)
        _require(_is_integer(self.seed, 0, MAX_SEED), "seed", f"an integer from 0 to {MAX_SEED}", self.seed)


@dataclass(frozen=True)
class RenderJob:
    """Frames of a scene become one archive. Exactly one of `poses` and `sampler` is given.

    Raises InvalidArgument, InvalidPose, InvalidImageSize, UnknownOutput.
    """

    scene: str
    poses: Poses | None = None  # [C, 4, 4] mm
    sampler: PoseSampler | None = None
    height: int | None = None  # None: as trained, else 512
    width: int | None = None
    outputs: tuple[str, ...] = ("bmode",)
    format: Literal["npz", "tar"] = "npz"

    kind = "render"

    def __post_init__(self) -> None:
        check_scene_name(self.scene)
        if (self.poses is None) == (self.sampler is None):
            raise InvalidArgument("exactly one of poses and sampler must be given", field="poses")
        if self.poses is not None:
            is_list = isinstance(self.poses, list) and 1 <= len(self.poses) <= MAX_FRAMES
            length = len(self.poses) if isinstance(self.poses, list) else self.poses
            _require(is_list, "poses", f"a list of 1 to {MAX_FRAMES} 4x4 matrices", length)
            object.__setattr__(self, "poses", check_poses(self.poses).tolist())
        check_image_size(1 if self.height is None else self.height, 1)
        check_image_size(1, 1 if self.width is None else self.width)
        is_names = isinstance(self.outputs, (list, tuple)) and all(isinstance(name, str) for name in self.outputs)
        _require(is_names, "outputs", "a list of outputs", self.outputs)
        object.__setattr__(self, "outputs", check_outputs(self.outputs))
        _require(self.format in FORMATS, "format", f"one of {', '.join(FORMATS)}", self.format)


Specification: TypeAlias = TrainJob | RenderJob
_KINDS: dict[str, type[TrainJob] | type[RenderJob]] = {one.kind: one for one in (TrainJob, RenderJob)}


def to_dict(specification: Specification) -> dict[str, Any]:
    """What JSON holds of it; `kind` comes first."""
    return {"kind": specification.kind, **json.loads(json.dumps(asdict(specification)))}


def from_dict(document: Mapping[str, Any]) -> Specification:
    """Inverse of `to_dict`; what is left out keeps its default. Raises InvalidArgument, whose field is a path."""
    values = dict(document)
    kind = values.pop("kind", None)
    _require(isinstance(kind, str) and kind in _KINDS, "kind", f"one of {', '.join(_KINDS)}", kind)
    sampler = values.get("sampler")
    if kind == RenderJob.kind and sampler is not None:
        values["sampler"] = _sampler(sampler)
    made = _make(_KINDS[kind], values)
    assert isinstance(made, (TrainJob, RenderJob))
    return made


def in_short(specification: Specification) -> dict[str, Any]:
    """As `to_dict`, but of poses only their number, as `pose_count`: what lists and views of jobs show."""
    document = to_dict(specification)
    poses = document.pop("poses", None)
    return document if poses is None else {**document, "pose_count": len(poses)}


def digest(specification: Specification, priority: int) -> str:
    """Tells two submissions apart: SHA-256, hexadecimal, of everything that was asked for."""
    document = {"specification": to_dict(specification), "priority": priority}
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()


def _sampler(document: Any) -> PoseSampler:
    _require(isinstance(document, Mapping), "sampler", "an object", document)
    try:
        made = _make(PoseSampler, {name: value for name, value in document.items() if value is not None})
    except InvalidArgument as error:
        name = f"sampler.{error.field}"
        raise InvalidArgument(error.detail.replace(str(error.field), name, 1), field=name) from None
    assert isinstance(made, PoseSampler)
    return made


def _make(cls: type[Any], values: dict[str, Any]) -> Any:
    known = {item.name for item in fields(cls)}
    for name in values:
        _require(name in known, str(name), f"left out: known are {', '.join(sorted(known))}", values[name])
    for item in fields(cls):
        if item.name not in values and item.name in ("dataset", "scene", "kind"):
            raise InvalidArgument(f"{item.name} is required", field=item.name)
    return cls(**values)


def _require(holds: bool, name: str, expected: str, given: Any) -> None:
    if not holds:
        told = repr(given)
        told = told if len(told) <= 100 else f"{told[:100]}…"
        raise InvalidArgument(f"{name} must be {expected}, got {told}", field=name)


def _is_integer(value: Any, low: int, high: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and low <= value <= high


def _is_finite(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
