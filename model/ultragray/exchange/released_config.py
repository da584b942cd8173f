"""conf.json of the released trainer: planes and width in centimetres, angle in degrees.

Keys that start with `_` are comments; keys that an import does not need are ignored. Some keys are ours, and the
released code ignores them: `image_height` and `image_width`, since an exported checkpoint comes without its training
images, `probe_kind`, "phased" for a fan that begins at the face, and `times_file_train` and `times_file_val`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ultragray.contract import checked_number
from ultragray.datasets.images import frame_size
from ultragray.errors import CheckpointInvalid, InvalidArgument, InvalidProbe
from ultragray.files import map_npy
from ultragray.geometry.probe import ConvexProbe, FloatArray, LinearProbe, PhasedProbe, Probe

MAX_CONFIG_BYTES = 1 << 20
WIDTH_KEY, ANGLE_KEY = "ultrasound_opening_width", "ultrasound_opening_angle"
KIND_KEY = "probe_kind"
FILE_KEYS = tuple(f"{kind}_file_{part}" for part in ("train", "val") for kind in ("images", "poses", "times"))


@dataclass(frozen=True)
class TrainingImages:
    """The shape of an images file."""

    path: Path
    count: int
    height: int
    width: int


@dataclass(frozen=True)
class ReleasedConfig:
    """The values of conf.json that a reader needs."""

    path: Path
    released_probe: Probe  # its far plane as released: on the grid (i+½)/(H−1)
    dataset_name: str | None
    files: Mapping[str, str]  # those of FILE_KEYS that it has, as written
    images: TrainingImages | None
    images_missing: str  # why `images` is None, as a clause
    image_height: int | None  # H and W of the training images, where conf.json itself says so
    image_width: int | None

    within: Path | None  # the only folder that is looked into; None: any

    def find(self, key: str) -> Path | None:
        """The file that a key names: as written, by its name beside conf.json, or from a folder above."""
        named = self.files.get(key)
        return None if named is None else _find(self.path, named, self.within)

    def probe(self, image_height: int) -> Probe:
        """The probe of ours for training images of `image_height` rows: the stretch of docs/physics.md §3."""
        released = self.released_probe
        try:
            return released.ending_at(stretch_released_far(released.near_mm, released.far_mm, image_height))
        except InvalidProbe as error:
            raise CheckpointInvalid(f"{self.path}: {error}") from error


def stretch_released_far(near: float, far_released: float, height: int) -> float:
    """The far plane of ours that puts H rows where the released code's grid (i+½)/(H−1) has them (same unit)."""
    if height < 2:
        raise InvalidProbe(f"the released depth grid needs at least 2 rows, got {height}", field="height")
    return near + (far_released - near) * height / (height - 1)


@dataclass(frozen=True)
class _Kind:
    """A kind of probe in conf.json: the key of its size across, that size, and the way back."""

    key: str
    size: Callable[[Any], float]
    probe: Callable[[float, float, float], Probe]  # of the size, near_mm, far_mm


_KINDS = {
    "linear": _Kind(
        WIDTH_KEY,
        lambda probe: _to_cm(probe.width_mm),
        lambda width_cm, near_mm, far_mm: LinearProbe(_to_mm(width_cm), near_mm, far_mm),
    ),
    "convex": _Kind(ANGLE_KEY, lambda probe: float(probe.opening_angle_deg), ConvexProbe),
    "phased": _Kind(
        ANGLE_KEY,
        lambda probe: float(probe.opening_angle_deg),
        lambda angle_deg, near_mm, far_mm: PhasedProbe(angle_deg, far_mm),
    ),
}
_IMPLIED_KIND = {WIDTH_KEY: "linear", ANGLE_KEY: "convex"}


def probe_keys(released_probe: Probe) -> dict[str, float | str]:
    """A probe, its planes as released, in keys of conf.json. Raises InvalidProbe for a kind that it cannot tell."""
    name = released_probe.kind
    if name not in _KINDS:
        raise InvalidProbe(f"the released format holds {', '.join(_KINDS)} probes, got {released_probe}", field="probe")
    kind = _KINDS[name]
    keys: dict[str, float | str] = {
        "ultrasound_near_plane": _to_cm(released_probe.near_mm),
        "ultrasound_far_plane": _to_cm(released_probe.far_mm),
        kind.key: kind.size(released_probe),
    }
    return keys if _IMPLIED_KIND[kind.key] == name else keys | {KIND_KEY: name}


def _read_probe(path: Path, document: Mapping[str, Any]) -> Probe:
    sizes = {key: _number(path, document, key) for key in (WIDTH_KEY, ANGLE_KEY) if document.get(key) is not None}
    if len(sizes) != 1:
        raise CheckpointInvalid(
            f"{path}: it must have exactly one of {WIDTH_KEY} (linear, cm) and "
            f"{ANGLE_KEY} (convex, degrees), got {'both' if sizes else 'neither'}"
        )
    ((key, size),) = sizes.items()
    near_mm, far_mm = (_to_mm(_number(path, document, f"ultrasound_{plane}_plane")) for plane in ("near", "far"))
    name = _IMPLIED_KIND[key] if document.get(KIND_KEY) is None else document[KIND_KEY]
    if not isinstance(name, str) or name not in _KINDS:
        raise CheckpointInvalid(f"{path}: {KIND_KEY} must be one of {', '.join(_KINDS)}, got {repr(name)[:40]}")
    kind = _KINDS[name]
    if kind.key != key:
        raise CheckpointInvalid(f"{path}: a {name} probe has {kind.key}, got {key}")
    try:
        probe = kind.probe(size, near_mm, far_mm)
    except InvalidProbe as error:
        raise CheckpointInvalid(f"{path}: {error}") from error
    if probe.near_mm != near_mm:
        raise CheckpointInvalid(f"{path}: a {name} probe has ultrasound_near_plane 0, got {near_mm / 10.0:g}")
    return probe


def released_centre_mm(released_probe: Probe, poses: FloatArray) -> FloatArray:  # [P, 4, 4] mm -> [3]
    """The origin of a scene trained from these poses: the mean corner of its images (docs/physics.md §6)."""
    corner = released_probe.corners_mm().mean(axis=0)  # [3]
    mean: FloatArray = (poses[:, :3, :3] @ corner + poses[:, :3, 3]).mean(axis=0)
    return mean


def read_released_config(path: str | Path, within: Path | None = None) -> ReleasedConfig:
    """Read conf.json and the shape of its images file; of one from a stranger, only `within` a folder.

    Raises CheckpointInvalid, naming the file.
    """
    path = Path(path)
    document = _read_object(path)
    files = {key: document[key] for key in FILE_KEYS if document.get(key) is not None}
    for key, value in files.items():
        if not isinstance(value, str):
            raise CheckpointInvalid(f"{path}: {key} must be a path, got {repr(value)[:40]}")
    images, images_missing = _find_images(path, files.get("images_file_train"), within)
    folder = Path(files.get("images_file_train", "")).parent  # data/liver/images_train.npy names `liver`
    return ReleasedConfig(
        path=path,
        released_probe=_read_probe(path, document),
        dataset_name=folder.name or path.resolve().parent.name or None,
        files=files,
        images=images,
        images_missing=images_missing,
        image_height=_count(path, document, "image_height", at_least=2),
        image_width=_count(path, document, "image_width", at_least=1),
        within=within,
    )


def _read_object(path: Path) -> Mapping[str, Any]:
    try:
        if not path.is_file():
            raise CheckpointInvalid(f"{path}: no such file")
        if path.stat().st_size > MAX_CONFIG_BYTES:
            raise CheckpointInvalid(f"{path}: too large for a conf.json: over {MAX_CONFIG_BYTES} bytes")
        document = json.loads(path.read_bytes())  # of any encoding of Unicode, with a mark or none
    except (OSError, ValueError) as error:
        raise CheckpointInvalid(f"{path}: not JSON that can be read: {error}") from error
    except RecursionError as error:
        raise CheckpointInvalid(f"{path}: it nests too deeply") from error
    if not isinstance(document, dict):
        raise CheckpointInvalid(f"{path}: it must be a JSON object, got {type(document).__name__}")
    return document


def _number(path: Path, document: Mapping[str, Any], key: str) -> float:
    if document.get(key) is None:
        raise CheckpointInvalid(f"{path}: it lacks {key}")
    try:
        return checked_number(document[key], float)
    except InvalidArgument as error:
        raise CheckpointInvalid(f"{path}: {key} {error}") from None


def _count(path: Path, document: Mapping[str, Any], key: str, *, at_least: int) -> int | None:
    try:
        return None if document.get(key) is None else int(checked_number(document[key], int, low=at_least))
    except InvalidArgument as error:
        raise CheckpointInvalid(f"{path}: {key} {error}") from None


def _find_images(path: Path, named: str | None, within: Path | None) -> tuple[TrainingImages | None, str]:
    if named is None:
        return None, f"{path} names no images_file_train"
    file = _find(path, named, within)
    return (None, f"the file {named[:200]!r} that {path} names was not found") if file is None else (_shape(file), "")


def _find(path: Path, named: str, within: Path | None) -> Path | None:
    """The first candidate that is a file. None at the first one outside `within`: whether it exists is not asked."""
    for candidate in _candidates(path, named):
        if within is not None and not candidate.is_relative_to(within):
            return None
        with suppress(OSError, ValueError):  # a name too long, or with a null byte
            if candidate.is_file():
                return candidate
    return None


def _candidates(path: Path, named: str) -> Iterator[Path]:
    """The path as written from conf.json's folder, then by name beside it, then as written from each folder above.

    A path that leads out of the folder comes after the name beside conf.json: a copied dataset must not find its
    original.
    """
    folder = path.resolve().parent
    as_written, beside = _joined(folder, named), folder / Path(named).name
    yield from (as_written, beside) if as_written.is_relative_to(folder) else (beside, as_written)
    for base in folder.parents:
        yield _joined(base, named)


def _joined(folder: Path, named: str) -> Path:
    return Path(os.path.normpath(folder / named))


def _shape(path: Path) -> TrainingImages:
    try:
        array = map_npy(path)
    except (OSError, ValueError) as error:
        raise CheckpointInvalid(f"{path}: not an array of images that can be read: {error}") from error
    if array.shape[:1] == (0,):
        raise CheckpointInvalid(f"{path}: it holds no frames")
    size = frame_size(array.shape)
    if size is None:
        raise CheckpointInvalid(
            f"{path}: images must have shape [N, H, W], [N, H, W, 1, 3 or 4] or [N, 1, H, W], got {list(array.shape)}"
        )
    return TrainingImages(path=path, count=len(array), height=size[0], width=size[1])


def _to_mm(length_cm: float) -> float:
    return round(10.0 * length_cm, 9)  # 3.79269 cm is 37.9269 mm, not 37.926899999999996


def _to_cm(length_mm: float) -> float:
    return round(length_mm / 10.0, 10)
