"""A scene as one PLY file, for tools that read point clouds: every parameter, to the bit, and back.

binary_little_endian 1.0. Element `vertex`, one a Gaussian, float32 properties named and ordered as in the PLY files of
the released code, lengths in cm about the scene's centre as in the scene file: x y z, f_dc_0, f_rest_0 … f_rest_(K−2),
opacity, scale_0 … scale_2 (logarithms), rot_0 … rot_3 (w, x, y, z), and `transmittance` (logit); then, where the
Gaussians carry labels, `label` (uchar). `opacity` is 1 throughout, for viewers that ask for it, and not read. Element
`training_pose`, 16 double properties m00 … m33: probe→scene, row by row, mm. Comments `ultragray …`, joined, are the
metadata of the scene file, JSON in ASCII without spaces.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import torch

from ultragray.errors import SceneFileInvalid
from ultragray.files import atomic_path
from ultragray.geometry.probe import FloatArray
from ultragray.scene.gaussians import GaussianScene
from ultragray.scene.info import MAX_SH_DEGREE, SceneInfo, info_from_json, info_to_json

MAX_HEADER_BYTES = 1 << 24
COMMENT_CHARACTERS = 200  # some readers keep a line in a buffer of 1024
UNITS = "lengths of vertex are cm about centre_mm, those of training_pose mm"
POSE_PROPERTIES = tuple(f"m{row}{column}" for row in range(4) for column in range(4))

Records: TypeAlias = npt.NDArray[np.void]
LABEL = "label"


def _parameter_properties(sh_degree: int) -> tuple[str, ...]:
    rest = (f"f_rest_{k}" for k in range((sh_degree + 1) ** 2 - 1))
    scales, rotation = (f"scale_{axis}" for axis in range(3)), (f"rot_{k}" for k in range(4))
    return ("x", "y", "z", "f_dc_0", *rest, "opacity", *scales, *rotation, "transmittance")


def write_ply(scene: GaussianScene, path: str | Path) -> None:
    """Write the scene, whole or not at all. Raises OSError where it cannot be written."""
    columns = {name: tensor.detach().to("cpu", torch.float32).numpy() for name, tensor in scene.splats.items()}
    opacity = np.ones((scene.gaussian_count, 1), np.float32)
    parameters = np.concatenate(
        [
            columns["means"],
            columns["sh0"][..., 0],
            columns["shN"][..., 0],
            opacity,
            columns["scales"],
            columns["quats"],
            columns["transmittances"][:, None],
        ],
        axis=1,
    )  # [N, 12 + K]
    element = _vertex_element(scene.info)
    vertices = np.empty(element.count, element.dtype)
    for name, column in zip(_parameter_properties(scene.sh_degree), parameters.T, strict=True):
        vertices[name] = column
    if scene.labels is not None:
        vertices[LABEL] = scene.labels.cpu().numpy()
    poses = scene.training_poses
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(_header_text(scene.info, element, len(poses)).encode("ascii"))
        file.write(vertices.tobytes())
        file.write(poses.astype("<f8").tobytes())


def _vertex_element(info: SceneInfo) -> _Element:
    properties = dict.fromkeys(_parameter_properties(info.sh_degree), "float")
    if info.label_names:
        properties[LABEL] = "uchar"
    return _Element("vertex", info.gaussian_count, properties)


def _header_text(info: SceneInfo, vertex: _Element, pose_count: int) -> str:
    metadata = json.dumps(json.loads(info_to_json(info)), separators=(",", ":"), sort_keys=True)
    metadata = metadata.replace(" ", r"\u0020")  # those left stand in strings; tools trim and squeeze comments
    pieces = [metadata[k : k + COMMENT_CHARACTERS] for k in range(0, len(metadata), COMMENT_CHARACTERS)]
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment UltraG-Ray scene: {UNITS}",
        *(f"comment ultragray {piece}" for piece in pieces),
        f"element vertex {vertex.count}",
        *(f"property {kind} {name}" for name, kind in vertex.properties.items()),
        f"element training_pose {pose_count}",
        *(f"property double {name}" for name in POSE_PROPERTIES),
        "end_header",
    ]
    return "\n".join(lines) + "\n"


def read_ply(path: str | Path) -> GaussianScene:
    """The scene of a PLY file that `write_ply` wrote, or that a tool rewrote with the comments.

    Properties may then stand in another order, and Gaussians be gone. Never runs code; raises SceneFileInvalid, naming
    the file and the reason.
    """
    path = Path(path)
    if not path.is_file():  # a pipe or a device would never end
        raise SceneFileInvalid(f"{path}: no such file")
    try:
        with path.open("rb") as file:
            size = path.stat().st_size
            header = _read_header(file.read(min(size, MAX_HEADER_BYTES)))
            expected = header.bytes + sum(element.bytes for element in header.elements)
            if size != expected:
                kind = "truncated" if size < expected else "longer than its header says"
                raise ValueError(f"it is {kind}: its header means {expected} bytes, it holds {size}")
            file.seek(header.bytes)
            tables = {element.name: element.read(file) for element in header.elements}
        return _scene(header.info, tables["vertex"], tables.get("training_pose"))
    except RecursionError as error:
        raise SceneFileInvalid(f"{path}: not a PLY scene: its metadata nests too deeply") from error
    except (OSError, ValueError, TypeError, OverflowError) as error:
        raise SceneFileInvalid(f"{path}: not a PLY scene that can be read: {error}") from error


@dataclass(frozen=True)
class _Element:
    """A table of the file: `count` records of little-endian numbers."""

    name: str
    count: int
    properties: Mapping[str, str]  # the type of each, in order

    @property
    def dtype(self) -> np.dtype[np.void]:
        return np.dtype([(name, _DTYPES[kind]) for name, kind in self.properties.items()])

    @property
    def bytes(self) -> int:
        return self.count * self.dtype.itemsize

    def read(self, file: Any) -> Records:  # [count]
        return np.frombuffer(file.read(self.bytes), dtype=self.dtype)


@dataclass(frozen=True)
class _Header:
    info: SceneInfo
    elements: tuple[_Element, ...]
    bytes: int


def _read_header(start: bytes) -> _Header:
    """The header at the start of a file. Raises ValueError, saying what is wrong."""
    if not start.startswith((b"ply\n", b"ply\r\n")):
        raise ValueError("it does not begin like a PLY file")
    end = re.search(rb"\nend_header\r?\n", start)
    if end is None:
        raise ValueError("it is truncated: its header has no end")
    lines = start[: end.start()].decode("ascii", errors="replace").splitlines()[1:]
    metadata: list[str] = []
    found: list[tuple[str, int, list[tuple[str, str]]]] = []  # elements: name, count, (type, name) of each property
    layout = None
    for line in lines:
        match line.split():
            case ["comment", "ultragray", *pieces]:
                metadata += pieces
            case ["comment" | "obj_info", *_]:
                pass
            case ["format", *words]:
                layout = " ".join(words)
            case ["element", name, count] if re.fullmatch(r"\d{1,15}", count):
                found.append((name, int(count), []))
            case ["property", kind, name] if found:
                found[-1][2].append((kind, name))
            case _:
                raise ValueError(f"its header has a line that it cannot have: {line[:80]!r}")
    if layout != "binary_little_endian 1.0":
        raise ValueError(f"its format is {layout or 'missing'}, expected binary_little_endian 1.0")
    if not metadata:
        raise ValueError("it has no comments `ultragray …` that say what it is a scene of")
    elements = tuple(_element(*element) for element in found)
    names = [element.name for element in elements]
    if sorted(names) not in (["vertex"], ["training_pose", "vertex"]):
        raise ValueError(f"its elements are {names}, expected vertex and training_pose")
    return _Header(info_from_json("".join(metadata)), elements, end.end())


_DTYPES = {"float": "<f4", "double": "<f8", "uchar": "u1"}
_OTHER_NAMES = {"float32": "float", "float64": "double", "uint8": "uchar"}


def _element(name: str, count: int, properties: Sequence[tuple[str, str]]) -> _Element:
    if name not in ("vertex", "training_pose"):
        raise ValueError(f"it has an element {name[:40]!r}, expected vertex and training_pose")
    names = [property_name for _, property_name in properties]
    if name == "vertex":
        rest = sum(property_name.startswith("f_rest_") for property_name in names)
        degree = next((d for d in range(MAX_SH_DEGREE + 1) if (d + 1) ** 2 - 1 == rest), 0)
        expected = dict.fromkeys(_parameter_properties(degree), "float")
        if LABEL in names:
            expected[LABEL] = "uchar"
    else:
        expected = dict.fromkeys(POSE_PROPERTIES, "double")
    if sorted(names) != sorted(expected):
        missing, surplus = sorted(set(expected) - set(names)), sorted(set(names) - set(expected))
        what = f"lacks {', '.join(missing)}" if missing else f"has {', '.join(surplus)[:80] or 'a property twice'}"
        raise ValueError(f"its {name} {what}, expected {' '.join(expected)}")
    for kind, property_name in properties:
        if _OTHER_NAMES.get(kind, kind) != expected[property_name]:
            raise ValueError(f"its {name} property {property_name} is {kind[:40]}, expected {expected[property_name]}")
    return _Element(name, count, {property_name: expected[property_name] for property_name in names})


def _scene(info: SceneInfo, vertices: Records, poses: Records | None) -> GaussianScene:
    def columns(*names: str) -> torch.Tensor:  # [N, len(names)]
        table = np.empty((len(vertices), len(names)), np.float32)
        for k, name in enumerate(names):
            table[:, k] = vertices[name]
        return torch.from_numpy(table)

    rest = sum(name.startswith("f_rest_") for name in vertices.dtype.names or ())
    splats = {
        "means": columns("x", "y", "z"),
        "scales": columns("scale_0", "scale_1", "scale_2"),
        "quats": columns("rot_0", "rot_1", "rot_2", "rot_3"),
        "transmittances": columns("transmittance")[:, 0],
        "sh0": columns("f_dc_0")[..., None],
        "shN": columns(*(f"f_rest_{k}" for k in range(rest)))[..., None],
    }
    training_poses: FloatArray | None = None
    if poses is not None:
        training_poses = np.stack([poses[name] for name in POSE_PROPERTIES], axis=-1).reshape(-1, 4, 4)
    labels = None
    if LABEL in (vertices.dtype.names or ()):
        labels = torch.from_numpy(vertices[LABEL].copy())
    return GaussianScene.from_splats(splats, info=info, training_poses=training_poses, labels=labels)
