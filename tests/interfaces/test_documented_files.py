"""Scene files and frames, as docs/interfaces.md lists them."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open

from ultragray import GaussianScene, PhasedProbe, SceneInfo, scene_info
from ultragray.confidence import Extrapolation
from ultragray.interchange import checkpoint_export, ply
from ultragray.outputs import OUTPUTS
from ultragray.settings import Encoding
from ultragray_service.http.reading import accept
from ultragray_workers.pool.process import encoding as pixels

from .document import code, rows, table

LABELS = torch.ones(5, dtype=torch.uint8)


def documented_arrays(heading: str, sizes: dict[str, int]) -> dict[str, tuple[str, list[int]]]:
    """Type and shape of each row, the letters of the shape replaced by sizes."""
    return {
        name: (code(kind)[0], [sizes.get(size) or int(size) for size in re.findall(r"[\w-]+", code(shape)[0])])
        for name, (kind, shape, _) in table(heading).items()
    }


def test_scene_file(tmp_path: Path) -> None:
    shapes = scene_info.expected_shapes(5, 1)
    splats = {name: torch.ones(shape) for name, shape in shapes.items()}
    poses = np.tile(np.eye(4), (2, 1, 1))
    scene = GaussianScene.from_splats(splats, training_poses=poses, labels=LABELS, pose_corrections=poses)
    scene.save(tmp_path / "scene.ugr")
    with safe_open(tmp_path / "scene.ugr", framework="numpy") as bundle:
        parts = {name: bundle.get_slice(name) for name in bundle.keys()}  # noqa: SIM118 (no mapping)
        found = {name: (part.get_dtype(), list(part.get_shape())) for name, part in parts.items()}
        assert set(bundle.metadata()) == {"ultragray"}
    assert documented_arrays("Tensors", {"N": 5, "K-1": 3, "P": 2}) == found
    left_out_where_empty = {"label_names": {}, "beam": None}
    defaults = json.loads(scene_info.info_to_json(SceneInfo())) | left_out_where_empty
    assert {key: json.loads(code(default)[0]) for key, (default, _) in table("Metadata keys").items()} == defaults


def test_ply_file(tmp_path: Path) -> None:
    splats = {name: torch.ones(shape) for name, shape in scene_info.expected_shapes(5, 1).items()}
    ply.write_ply(GaussianScene.from_splats(splats, labels=LABELS), tmp_path / "scene.ply")
    header = (tmp_path / "scene.ply").read_bytes().split(b"end_header")[0].decode()
    element, found = "", []
    for line in header.splitlines():
        match line.split():
            case ["element", name, _]:
                element = name
            case ["property", kind, name]:
                found.append((name, element, kind))
    documented = [
        (name, code(element)[0], code(kind)[0]) for names, element, kind, _ in rows("PLY file") for name in code(names)
    ]
    assert documented == found


def test_exported_checkpoint(tmp_path: Path) -> None:
    splats = {name: torch.ones(shape) for name, shape in scene_info.expected_shapes(5, 1).items()}
    info = SceneInfo(probe=PhasedProbe(60, 50))
    scene = GaussianScene.from_splats(splats, info=info, training_poses=np.eye(4)[None])
    written = checkpoint_export.export_checkpoint(scene, tmp_path / "ckpt_29999.pt").files
    documented = table("Exported checkpoint")
    assert set(documented) == {path.name for path in written}
    assert code(documented["ckpt_29999.pt"][0]) == list(torch.load(tmp_path / "ckpt_29999.pt", weights_only=True))
    keys = set(code(documented["conf.json"][0]))
    assert keys == {*json.loads((tmp_path / "conf.json").read_text()), "ultrasound_opening_width"}


def test_frames() -> None:
    assert list(table("Outputs")) == list(OUTPUTS)
    documented = {name: code(media_type)[0] for name, (media_type, _) in table("Encodings").items()}
    assert set(documented) == {encoding.value for encoding in Encoding}
    for name, media_type in documented.items():
        dtype = name if media_type == accept.RAW else None
        assert accept.choose(media_type, frames=1, outputs=1, dtype=dtype).encoding is Encoding(name)


def test_npz() -> None:
    file = io.BytesIO()
    frames = {name: np.zeros((2, 3, 5), np.float32) for name in OUTPUTS}
    told = [Extrapolation(None, None, None, None)] * 2
    pixels.write_npz(file, frames, np.zeros((2, 4, 4)), told, scene="demo", scene_sha256="0" * 64, renderer="ultragray")
    file.seek(0)
    with np.load(file) as archive:
        found = {
            name: ("str" if array.dtype.kind == "U" else array.dtype.name, list(array.shape))
            for name, array in archive.items()
        }
    assert documented_arrays("npz keys", {"C": 2, "H": 3, "W": 5}) == found
