"""A scene file's description of itself, readable without torch: the header of the safetensors bundle.

The file is one safetensors bundle. Tensors: means [N, 3] cm, scales [N, 3] log cm, quats [N, 4] wxyz, transmittances
[N] logit, sh0 [N, 1, 1], shN [N, K−1, 1], all float32, training_poses [P, 4, 4] float64 mm; where these were corrected,
pose_corrections likewise; where tissue followed the probe, rest_poses likewise; and, where the Gaussians carry labels,
labels [N] uint8. Its metadata holds an entry `ultragray`, a JSON object with the fields of SceneInfo, and, where its
tissue moves, one of its modes (see `modes`). In a compressed one (.ugz) the tensors `compressed`, part.00, part.01 …
(see `compressed`) stand in the place of those of the Gaussians. All but the Gaussians is bounded, so that the
description of any file is read in little memory and time.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from safetensors import SafetensorError, safe_open

from ultragray.contract import Contract, checked_number, described, from_dict, to_dict, under
from ultragray.errors import InvalidArgument, InvalidProbe, SceneFileInvalid
from ultragray.files import require_version
from ultragray.geometry.image_size import DEFAULT_IMAGE_SIDE
from ultragray.geometry.pose import MAX_POSITION_MM, check_poses
from ultragray.geometry.probe import PLANE, ElevationBeam, FloatArray, Probe
from ultragray.scene.compressed import COMPRESSED_TENSOR, MAX_PARTS, check_tensor, part_name, unpack
from ultragray.scene.confidence import read_model
from ultragray.scene.modes import MOTION_KEY, Motion, Moving
from ultragray.scene.speckle import SpeckleModel

FORMAT_VERSION = 1
METADATA_KEY = "ultragray"
INTENSITIES = ("released", "sigmoid")
MAX_SH_DEGREE = 3
MAX_LABEL = 255
UNPAINTED = 255  # in frames that somebody painted: a pixel of which nothing is said
DEFAULT_WITHIN_MM, MAX_WITHIN_MM = 4.0, 50.0  # how far labels spread to Gaussians beside
MAX_HEADER_BYTES = 4 * 2**20  # of the bundle: names and shapes of tensors, and the metadata
_NO_HEADER_BYTES = 1 << 40  # a number of bytes beyond is none: other files begin so
MAX_TRAINING_POSES = 100_000
MAX_METRICS = 1000
LABELS_TENSOR = "labels"
CORRECTIONS_TENSOR = "pose_corrections"
REST_TENSOR = "rest_poses"
BESIDE = (CORRECTIONS_TENSOR, REST_TENSOR)  # tensors that a scene may have beside its training poses
_LENGTH_BYTES = 8  # a safetensors bundle starts with the length of its header, little endian

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class SceneInfo(Contract):
    """A scene's own description. Positions are in mm; `bounds` and `centre` in the frame of the training sweep."""

    centre_mm: Vector = described("0 of the Gaussians.", (0.0,) * 3, low=-MAX_POSITION_MM, high=MAX_POSITION_MM)
    probe: Probe | None = None
    image_height: int | None = described("H of the training images.", None, low=1)
    image_width: int | None = described("W of the training images.", None, low=1)
    intensity: str = described("Activation of docs/physics.md §2.", "released", choices=INTENSITIES)
    sh_degree: int = described("Of the Gaussians' spherical harmonics.", 0, low=0, high=MAX_SH_DEGREE)
    gaussian_count: int = described("N.", 0, low=0)
    bounds_min_mm: Vector = (0.0, 0.0, 0.0)  # of the Gaussians' means
    bounds_max_mm: Vector = (0.0, 0.0, 0.0)
    dataset_name: str | None = None
    dataset_sha256: str | None = None
    metrics: dict[str, float] = described("Of held-out frames.", factory=dict, most=MAX_METRICS)
    training: dict[str, Any] = described("The configuration the scene was made with.", factory=dict)
    confidence: dict[str, Any] = described("Of ultragray.scene.confidence.ConfidenceModel; empty: none.", factory=dict)
    label_names: dict[int, str] = described("By label, 1 to 255; empty: the scene carries none.", factory=dict)
    beam: ElevationBeam | None = described("Of the frames it was trained on; none: as thick as its Gaussians.", None)
    speckle: SpeckleModel | None = described("Of the frames it was trained on; none: not known.", None)
    tissue_shares: Vector | None = described(
        "Of the probe's motion within the image plane (lateral, axial, turn) that tissue did not go along with, each "
        "from 0 to 1; none: tissue is rigid, and poses lead into it as they are.",
        None,
        low=0.0,
        high=1.0,
    )

    motion: Motion | None = described("Modes by which its tissue moves; none: it is still.", None)
    provenance: dict[str, Any] = described(
        "What an edit made it of: `parents`, SHA-256 by name; `edits`; `made`, labels of what was never recorded. "
        "Empty: it was trained.",
        factory=dict,
    )

    def __post_init__(self) -> None:
        object.__setattr__(self, "label_names", _label_names(self.label_names))
        super().__post_init__()
        for name, value in self.metrics.items():
            with under(f"metrics.{name}"):
                checked_number(value, float)

    @property
    def made_labels(self) -> tuple[int, ...]:
        """Labels of Gaussians that stand for nothing that was recorded."""
        labels = self.provenance.get("made", ())
        return tuple(label for label in self.label_names if label in labels)

    def probe_or(self, probe: Probe | None) -> Probe:
        """The probe asked for, else the one the scene was trained with.

        Raises InvalidProbe where neither is known, and for what is no Probe.
        """
        if probe is not None and not isinstance(probe, Probe):
            raise InvalidProbe(f"probe must be a Probe, such as LinearProbe(…), got {probe!r}", field="probe")
        known_probe = probe or self.probe
        if known_probe is None:
            raise InvalidProbe(
                "probe must be given: the scene does not know the one it was trained with", field="probe"
            )
        return known_probe

    def beam_or(self, thickness_mm: float | None) -> ElevationBeam:
        """The beam of the scene, as thick as asked for (None: as it is); where it has none, one without a focus."""
        if self.beam is None:
            return PLANE if thickness_mm is None else ElevationBeam(thickness_mm)
        return self.beam if thickness_mm is None else replace(self.beam, thickness_mm=thickness_mm)

    def image_size_or(self, height: int | None, width: int | None) -> tuple[int, int]:
        """Height and width as asked for, else those of the training images, else 512."""
        return (
            height if height is not None else self.image_height or DEFAULT_IMAGE_SIDE,
            width if width is not None else self.image_width or DEFAULT_IMAGE_SIDE,
        )


def _label_names(names: Any) -> dict[int, str]:
    """With numbers for keys, which JSON writes as text, in their order."""
    try:
        by_label = {int(label): name for label, name in names.items()}
    except (AttributeError, TypeError, ValueError):
        by_label = {0: ""}
    if not all(1 <= label <= MAX_LABEL and isinstance(name, str) and name for label, name in by_label.items()):
        raise InvalidArgument(
            f"label_names must give labels from 1 to {MAX_LABEL} a name each, got {names!r}", field="label_names"
        )
    return dict(sorted(by_label.items()))


def info_to_json(info: SceneInfo) -> str:
    document = {"format_version": FORMAT_VERSION, **to_dict(info)}
    del document["motion"]  # an entry of its own in the file
    for name in ("label_names", "beam", "speckle", "tissue_shares", "provenance"):
        if not document[name]:
            del document[name]  # a scene without them keeps its bytes, and its hash
    return json.dumps(document, allow_nan=False, sort_keys=True)


def _refuse_constant(constant: str) -> None:
    raise ValueError(f"its metadata holds {constant}, which JSON does not have")


def info_from_json(text: str) -> SceneInfo:
    """Inverse of `info_to_json`. Raises ValueError (InvalidArgument among them), saying what is wrong."""
    document = json.loads(text, parse_constant=_refuse_constant)
    if not isinstance(document, dict):
        raise ValueError("its metadata is not a JSON object")
    require_version(document.pop("format_version", None), FORMAT_VERSION)
    unknown = set(document) - set(SceneInfo.__dataclass_fields__) | {"motion"} & set(document)
    if unknown:
        raise ValueError(f"its metadata has unknown keys {sorted(unknown)}")
    if document.get("probe") is not None:
        document["probe"] = from_dict(Probe, document["probe"])
    if document.get("beam") is not None:
        document["beam"] = from_dict(ElevationBeam, document["beam"])
    if document.get("speckle") is not None:
        document["speckle"] = from_dict(SpeckleModel, document["speckle"])
    return SceneInfo(**document)


def expected_shapes(count: int, sh_degree: int) -> dict[str, tuple[int, ...]]:
    """Shapes of the six parameter tensors for N = `count` Gaussians."""
    return {
        "means": (count, 3),
        "scales": (count, 3),
        "quats": (count, 4),
        "transmittances": (count,),
        "sh0": (count, 1, 1),
        "shN": (count, (sh_degree + 1) ** 2 - 1, 1),
    }


@dataclass(frozen=True)
class SceneHeader:
    """The description and the training poses of a scene file, without the Gaussians."""

    info: SceneInfo
    training_poses: FloatArray = field(repr=False)  # [P, 4, 4] mm, probe→scene
    file_bytes: int
    # [P, 4, 4] mm: training poses = corrections · poses of the tracker
    pose_corrections: FloatArray | None = field(default=None, repr=False)
    # [P, 4, 4] mm: where the tissue at rest looks as the training frames do; None: at the training poses
    rest_poses: FloatArray | None = field(default=None, repr=False)
    moving: Moving | None = field(default=None, repr=False)
    is_compressed: bool = field(default=False, repr=False)
    text_bytes: int = field(default=0, repr=False)  # of the bundle's header: the description, and where each tensor is


def read_header(path: str | Path) -> SceneHeader:
    """The description of a scene file, without loading its Gaussians and without torch.

    Raises SceneFileInvalid, naming the file and the reason, for anything that is not a complete scene file.
    """
    path = Path(path)
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            text_bytes = _LENGTH_BYTES + check_header_size(file.read(_LENGTH_BYTES))
        with safe_open(path, framework="numpy") as bundle:
            metadata = bundle.metadata() or {}
            if METADATA_KEY not in metadata:
                raise ValueError("it is a safetensors file, but not one of ultragray's")
            moving = Moving.from_json(metadata[MOTION_KEY]) if MOTION_KEY in metadata else None
            info = replace(info_from_json(metadata[METADATA_KEY]), motion=None if moving is None else moving.motion)
            is_compressed = COMPRESSED_TENSOR in bundle.keys()  # noqa: SIM118
            (_check_parts if is_compressed else _check_gaussians)(bundle, info)
            _check_poses(bundle)
            poses = check_poses(bundle.get_tensor("training_poses"), field="training_poses")
            beside = {
                name: check_beside(name, bundle.get_tensor(name), len(poses)) if name in bundle.keys() else None  # noqa: SIM118
                for name in BESIDE
            }
            check_tissue(info, beside[REST_TENSOR])
            read_model(info.confidence, len(poses))
            if is_compressed:
                checksum = bundle.get_tensor(COMPRESSED_TENSOR).tobytes()
                check_tensor(checksum, metadata[METADATA_KEY], poses, *beside.values())
    except (OSError, SafetensorError, ValueError, TypeError, RecursionError) as error:
        raise scene_file_invalid(path, error) from error
    return SceneHeader(info, poses, size, **beside, moving=moving, is_compressed=is_compressed, text_bytes=text_bytes)


def with_metadata_in_order(data: bytes) -> bytes:
    """A bundle with the entries of its metadata by name: safetensors writes several in an order that changes."""
    end = _LENGTH_BYTES + int.from_bytes(data[:_LENGTH_BYTES], "little")
    header = json.loads(data[_LENGTH_BYTES:end])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % _LENGTH_BYTES)  # tensors begin at a multiple of 8 bytes
    return len(text).to_bytes(_LENGTH_BYTES, "little") + text + data[end:]


def read_gaussians(path: str | Path, info: SceneInfo) -> dict[str, npt.NDArray[Any]]:
    """The raw parameters [N, ...] of a scene file of this description and, where it names some, its labels [N].

    Raises OSError, SafetensorError, ValueError where the file is damaged, or another than the one described.
    """
    with safe_open(path, framework="numpy") as bundle:
        names = set(bundle.keys()) - {COMPRESSED_TENSOR, "training_poses", *BESIDE}
        tensors = {name: bundle.get_tensor(name) for name in sorted(names)}
        if COMPRESSED_TENSOR not in bundle.keys():  # noqa: SIM118
            return tensors
    parts = [part.tobytes() for part in tensors.values()]
    return unpack(parts, info.gaussian_count, info.sh_degree, bool(info.label_names))


def check_beside(name: str, motions: Any, count: int) -> FloatArray:  # [P, 4, 4] mm
    """Rigid motions, one for each of `count` training poses. Raises InvalidPose and InvalidArgument."""
    exact = check_poses(motions, field=name)
    if len(exact) != count:
        raise InvalidArgument(f"{name} must be {count}, one for each training pose, got {len(exact)}", field=name)
    return exact


def check_tissue(info: SceneInfo, rest_poses: FloatArray | None) -> None:
    """Raises InvalidArgument where some is missing of what says how tissue follows the probe."""
    if info.tissue_shares is None and rest_poses is None:
        return
    if info.tissue_shares is None or rest_poses is None or not len(rest_poses) or info.probe is None:
        raise InvalidArgument(
            f"tissue_shares, {REST_TENSOR} (one or more) and a probe belong together: a scene has all, or neither of "
            "the first two",
            field="tissue_shares",
        )


def check_header_size(start: bytes) -> int:
    """The bytes of the header of a bundle that starts so. Raises InvalidArgument for more than a scene's may have."""
    size = int.from_bytes(start[:_LENGTH_BYTES], "little")
    if size > _NO_HEADER_BYTES:
        raise InvalidArgument("it does not begin as a scene file does: it is damaged, or a file of another kind")
    if size > MAX_HEADER_BYTES:
        raise InvalidArgument(f"the header of a scene file may have {MAX_HEADER_BYTES} bytes, it says {size}")
    return size


def check_training_pose_count(count: int) -> None:
    if count > MAX_TRAINING_POSES:
        raise InvalidArgument(
            f"training_poses must be at most {MAX_TRAINING_POSES}, got {count}", field="training_poses"
        )


def _check_gaussians(bundle: Any, info: SceneInfo) -> None:
    shapes = expected_shapes(info.gaussian_count, info.sh_degree)
    if info.label_names:
        shapes[LABELS_TENSOR] = (info.gaussian_count,)
    _check_names(bundle, info, [*shapes])
    for name, shape in shapes.items():
        part, dtype = bundle.get_slice(name), "U8" if name == LABELS_TENSOR else "F32"
        if tuple(part.get_shape()) != shape or part.get_dtype() != dtype:
            raise ValueError(
                f"its tensor {name} is {part.get_dtype()} {list(part.get_shape())}, expected {dtype} {list(shape)}"
            )


def _check_parts(bundle: Any, info: SceneInfo) -> None:
    count = len(set(bundle.keys()) - {COMPRESSED_TENSOR, "training_poses", *BESIDE})
    names = [COMPRESSED_TENSOR, *(part_name(index) for index in range(min(max(count, 1), MAX_PARTS)))]
    _check_names(bundle, info, names)
    for name in names:
        part = bundle.get_slice(name)
        if part.get_dtype() != "U8" or len(part.get_shape()) != 1:
            raise ValueError(f"its tensor {name} is {part.get_dtype()} {list(part.get_shape())}, expected U8 [bytes]")


def _check_names(bundle: Any, info: SceneInfo, of_gaussians: list[str]) -> None:
    if not info.gaussian_count:
        raise ValueError("it holds no Gaussians")
    names, expected = set(bundle.keys()), sorted([*of_gaussians, "training_poses"])
    if names - set(BESIDE) != set(expected):
        raise ValueError(f"its tensors are {sorted(names)}, expected {expected}")


def _check_poses(bundle: Any) -> None:
    for name in sorted(set(bundle.keys()) & {"training_poses", *BESIDE}):
        poses = bundle.get_slice(name)
        if poses.get_dtype() != "F64" or len(poses.get_shape()) != 3:
            raise ValueError(
                f"its tensor {name} is {poses.get_dtype()} {list(poses.get_shape())}, expected F64 [P, 4, 4]"
            )
        check_training_pose_count(poses.get_shape()[0])


def scene_file_invalid(path: str | Path, error: Exception) -> SceneFileInvalid:
    """The one sentence for a scene file that cannot be read."""
    if isinstance(error, FileNotFoundError):
        return SceneFileInvalid(f"{path}: no such file")
    if isinstance(error, RecursionError):
        return SceneFileInvalid(f"{path}: not a scene file: its metadata nests too deeply")
    if isinstance(error, SafetensorError):
        is_cut = "incomplete metadata" in str(error)
        return SceneFileInvalid(f"{path}: {'cut off: its header tells of more' if is_cut else 'not a scene file'}")
    reason = error.strerror if isinstance(error, OSError) and error.strerror else error  # the whole would name the path
    return SceneFileInvalid(f"{path}: not a scene file that can be read: {reason}")


def with_summary(info: SceneInfo, means_cm: FloatArray, sh_degree: int) -> SceneInfo:  # means [N, 3]
    """`info` with the count, degree and bounds of the Gaussians it goes with."""
    centre = np.asarray(info.centre_mm)
    if len(means_cm):
        low, high = centre + 10.0 * means_cm.min(axis=0), centre + 10.0 * means_cm.max(axis=0)
    else:
        low = high = centre
    bounds = {"bounds_min_mm": low.tolist(), "bounds_max_mm": high.tolist()}
    return replace(info, gaussian_count=len(means_cm), sh_degree=sh_degree, **bounds)
