"""A scene as one PLY file, for tools that read point clouds: every parameter, to the bit, and back.

binary_little_endian 1.0. Element `vertex`, one a Gaussian, float32 properties named and ordered as in the PLY files of
the released code, lengths in cm about the scene's centre as in the scene file: x y z, f_dc_0, f_rest_0 … f_rest_(K−2),
opacity, scale_0 … scale_2 (logarithms), rot_0 … rot_3 (w, x, y, z), and `transmittance` (logit); then, where the
Gaussians carry labels, `label` (uchar). `opacity` is 1 throughout, for viewers that ask for it, and not read. Element
`training_pose`, 16 double properties m00 … m33: probe→scene, row by row, mm. Comments `ultragray …`, joined, are the
metadata of the scene file, JSON in ASCII without spaces.

Reader and writer are ours: plyfile is under the GPL, and other readers of PLY drop the comments or the second element.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import torch

from ultragray.errors import SceneFileInvalid
from ultragray.files import atomic_path
from ultragray.scene.gaussians import GaussianScene
from ultragray.scene.info import MAX_SH_DEGREE, info_from_json, info_to_json

MAX_HEADER_BYTES = 1 << 24
COMMENT_CHARACTERS = 200  # some readers keep a line in a buffer of 1024
UNITS = "UltraG-Ray scene: lengths of vertex are cm about centre_mm, those of training_pose mm"
LABEL = "label"

LAYOUT = "format binary_little_endian 1.0"
_DTYPES = {"float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8", "uchar": "|u1", "uint8": "|u1"}
_KINDS = {"<f4": "float", "<f8": "double", "|u1": "uchar"}

Records: TypeAlias = npt.NDArray[np.void]
_POSE = np.dtype([(f"m{row}{column}", "<f8") for row in range(4) for column in range(4)])


def _vertex(sh_degree: int, has_labels: bool) -> np.dtype[np.void]:
    rest = (f"f_rest_{k}" for k in range((sh_degree + 1) ** 2 - 1))
    scales, rotation = (f"scale_{axis}" for axis in range(3)), (f"rot_{k}" for k in range(4))
    names = ("x", "y", "z", "f_dc_0", *rest, "opacity", *scales, *rotation, "transmittance")
    return np.dtype([*((name, "<f4") for name in names), *([(LABEL, "u1")] if has_labels else [])])


def write_ply(scene: GaussianScene, path: str | Path) -> None:
    """Write the scene, whole or not at all. Raises OSError where it cannot be written."""
    columns = {name: tensor.detach().to("cpu", torch.float32).numpy() for name, tensor in scene.splats.items()}
    parameters = np.concatenate(
        [
            columns["means"],
            columns["sh0"][..., 0],
            columns["shN"][..., 0],
            np.ones((scene.gaussian_count, 1), np.float32),
            columns["scales"],
            columns["quats"],
            columns["transmittances"][:, None],
        ],
        axis=1,
    )  # [N, 12 + K]
    vertices = np.empty(scene.gaussian_count, _vertex(scene.sh_degree, bool(scene.info.label_names)))
    for name, column in zip(vertices.dtype.names or (), parameters.T, strict=False):  # the labels have none
        vertices[name] = column
    if scene.labels is not None:
        vertices[LABEL] = scene.labels.cpu().numpy()
    poses = np.ascontiguousarray(scene.training_poses.reshape(-1, 16), "<f8").view(_POSE)[:, 0]
    metadata = json.dumps(json.loads(info_to_json(scene.info)), separators=(",", ":"), sort_keys=True)
    metadata = metadata.replace(" ", r"\u0020")  # those left stand in strings; tools trim and squeeze comments
    pieces = ["ultragray " + metadata[k : k + COMMENT_CHARACTERS] for k in range(0, len(metadata), COMMENT_CHARACTERS)]
    lines = ["ply", LAYOUT, *(f"comment {text}" for text in (UNITS, *pieces))]
    tables = {"vertex": vertices, "training_pose": poses}
    for name, table in tables.items():
        lines.append(f"element {name} {len(table)}")
        lines += [f"property {_KINDS[kind]} {column}" for column, kind, *_ in table.dtype.descr]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join([*lines, "end_header\n"]).encode("ascii"))
        for table in tables.values():
            file.write(table.tobytes())


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
            header, end, _ = file.read(MAX_HEADER_BYTES).partition(b"\nend_header")
            if not header.startswith((b"ply\n", b"ply\r\n")):
                raise ValueError("it does not begin like a PLY file")
            if not end:
                raise ValueError("it is truncated: its header has no end")
            metadata, elements = _read_header(header.decode("ascii", errors="replace").splitlines()[1:])
            file.seek(len(header) + 1)
            file.readline()  # end_header
            begin, size = file.tell(), path.stat().st_size
            expected = begin + sum(count * dtype.itemsize for count, dtype in elements.values())
            if size != expected:
                kind = "truncated" if size < expected else "longer than its header says"
                raise ValueError(f"it is {kind}: its header means {expected} bytes, it holds {size}")
            tables = {name: np.fromfile(file, dtype, count) for name, (count, dtype) in elements.items()}
        return _scene(metadata, tables["vertex"], tables.get("training_pose"))
    except RecursionError as error:
        raise SceneFileInvalid(f"{path}: not a PLY scene: its metadata nests too deeply") from error
    except (OSError, ValueError, TypeError, OverflowError) as error:
        raise SceneFileInvalid(f"{path}: not a PLY scene that can be read: {error}") from error


def _read_header(lines: list[str]) -> tuple[str, dict[str, tuple[int, np.dtype[np.void]]]]:
    """The metadata, and of each element its number of records and their type. Raises ValueError."""
    metadata, layout = "", "format missing"
    elements: dict[str, tuple[int, list[tuple[str, str]]]] = {}
    for line in lines:
        match line.split():
            case ["comment", "ultragray", *pieces]:
                metadata += "".join(pieces)
            case ["comment" | "obj_info", *_]:
                pass
            case ["format", *_]:
                layout = " ".join(line.split())
            case ["element", "vertex" | "training_pose" as name, count] if re.fullmatch(r"\d{1,15}", count):
                elements[name] = (int(count), [])
            case ["element", name, _] if name not in ("vertex", "training_pose"):
                raise ValueError(f"it has an element {name[:40]!r}, expected vertex and training_pose")
            case ["property", kind, name] if elements and kind in _DTYPES:
                elements[list(elements)[-1]][1].append((name, _DTYPES[kind]))
            case _:
                raise ValueError(f"its header has a line that it cannot have: {line[:80]!r}")
    if layout != LAYOUT:
        raise ValueError(f"its {layout.replace('format', 'format is')[:80]}, expected {LAYOUT.removeprefix('format ')}")
    if not metadata:
        raise ValueError("it has no comments `ultragray …` that say what it is a scene of")
    if "vertex" not in elements:
        raise ValueError(f"its elements are {list(elements)}, expected vertex and training_pose")
    return metadata, {name: (count, _record(name, columns)) for name, (count, columns) in elements.items()}


def _record(name: str, columns: list[tuple[str, str]]) -> np.dtype[np.void]:
    """The type of an element's records, whose properties are those of a scene in any order. Raises ValueError."""
    kinds = dict(columns)
    rest = sum(column.startswith("f_rest_") for column in kinds)
    degree = next((d for d in range(MAX_SH_DEGREE + 1) if (d + 1) ** 2 - 1 == rest), 0)
    kind_of = _vertex(degree, LABEL in kinds) if name == "vertex" else _POSE
    wanted = {column: kind for column, kind, *_ in kind_of.descr}
    if missing := sorted(wanted.keys() - kinds.keys()):
        raise ValueError(f"its {name} lacks {', '.join(missing)}")
    if surplus := sorted(kinds.keys() - wanted.keys()):
        raise ValueError(f"its {name} has {', '.join(surplus)[:80]}, which no scene has")
    if len(kinds) != len(columns):
        raise ValueError(f"its {name} has a property twice")
    for column, kind in columns:
        if kind != wanted[column]:
            raise ValueError(f"its {name} property {column} is {_KINDS[kind]}, expected {_KINDS[wanted[column]]}")
    return np.dtype(columns)


def _scene(metadata: str, vertices: Records, poses: Records | None) -> GaussianScene:
    rest = sum(name.startswith("f_rest_") for name in vertices.dtype.names or ())

    def columns(*chosen: str) -> Any:  # [N, len(chosen)]
        values = np.array([vertices[name] for name in chosen], np.float32)
        return torch.from_numpy(values.reshape(len(chosen), len(vertices)).T.copy())

    splats = {
        "means": columns("x", "y", "z"),
        "scales": columns("scale_0", "scale_1", "scale_2"),
        "quats": columns("rot_0", "rot_1", "rot_2", "rot_3"),
        "transmittances": columns("transmittance")[:, 0],
        "sh0": columns("f_dc_0")[..., None],
        "shN": columns(*(f"f_rest_{k}" for k in range(rest)))[..., None],
    }
    training_poses = None
    if poses is not None:
        training_poses = np.stack([poses[name] for name in _POSE.names or ()], axis=-1).reshape(-1, 4, 4)
    labels = torch.from_numpy(np.array(vertices[LABEL])) if LABEL in (vertices.dtype.names or ()) else None
    return GaussianScene.from_splats(
        splats, info=info_from_json(metadata), training_poses=training_poses, labels=labels
    )
