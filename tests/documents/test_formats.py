"""Formats of files and messages are those that people describe in the reference: contracts, told in words."""

import io
import json

import numpy as np
import torch
from safetensors import safe_open

from ultragray import GaussianScene, PhasedProbe, SceneInfo
from ultragray.errors import error_classes
from ultragray.exchange import checkpoint as checkpoint_export
from ultragray.exchange import ply
from ultragray.rendering.outputs import OUTPUTS
from ultragray.rendering.settings import Encoding
from ultragray.scene import info as scene_info
from ultragray.scene.confidence import Extrapolation
from ultragray_service.http import accept
from ultragray_service.igtl.contents import CAPABILITY
from ultragray_service.rpc import calls as status
from ultragray_workers.pool import pixels

from .tables import code, rows

LABELS = torch.ones(5, dtype=torch.uint8)
SPLATS = {name: torch.ones(shape) for name, shape in scene_info.expected_shapes(5, 1).items()}


def test_scene_file(tmp_path):
    poses = np.tile(np.eye(4), (2, 1, 1))
    info = SceneInfo(probe=PhasedProbe(60, 50), tissue_shares=(1.0, 0.5, 0.0))
    scene = GaussianScene.from_splats(
        SPLATS, info=info, training_poses=poses, labels=LABELS, pose_corrections=poses, rest_poses=poses
    )
    scene.save(tmp_path / "scene.ugr")
    with safe_open(tmp_path / "scene.ugr", framework="numpy") as bundle:
        parts = {name: bundle.get_slice(name) for name in bundle.keys()}  # noqa: SIM118 (no mapping)
        found = {name: (part.get_dtype(), list(part.get_shape())) for name, part in parts.items()}
        assert set(bundle.metadata()) == {"ultragray"}
    sizes = {"N": 5, "K-1": 3, "P": 2}
    documented = {
        code(name)[0]: (code(kind)[0], [sizes.get(size) or int(size) for size in code(shape)[0][1:-1].split(", ")])
        for name, kind, shape, _ in rows("scene-file.md", "Tensors")
    }
    assert documented == found


def test_ply_file(tmp_path):
    ply.write_ply(GaussianScene.from_splats(SPLATS, labels=LABELS), tmp_path / "scene.ply")
    header = (tmp_path / "scene.ply").read_bytes().split(b"end_header")[0].decode()
    element, found = "", []
    for line in header.splitlines():
        match line.split():
            case ["element", name, _]:
                element = name
            case ["property", kind, name]:
                found.append((name, element, kind))
    documented = [
        (name, code(element)[0], code(kind)[0])
        for names, element, kind, _ in rows("scene-file.md", "PLY file")
        for name in code(names)
    ]
    assert documented == found


def test_exported_checkpoint(tmp_path):
    scene = GaussianScene.from_splats(SPLATS, info=SceneInfo(probe=PhasedProbe(60, 50)), training_poses=np.eye(4)[None])
    written = checkpoint_export.export_checkpoint(scene, tmp_path / "ckpt_29999.pt").files
    documented = {code(name)[0]: code(holds) for name, holds in rows("scene-file.md", "Exported checkpoint")}
    assert set(documented) == {path.name for path in written}
    assert documented["ckpt_29999.pt"] == list(torch.load(tmp_path / "ckpt_29999.pt", weights_only=True))
    keys = {*json.loads((tmp_path / "conf.json").read_text()), "ultrasound_opening_width"}
    assert set(documented["conf.json"]) == keys


def test_npz(generator):
    file = io.BytesIO()
    frames = {name: np.zeros((2, 3, 5), np.float32) for name in OUTPUTS}
    told = [Extrapolation(None, None, None, None)] * 2
    pixels.write_npz(file, frames, np.zeros((2, 4, 4)), told, scene="demo", scene_sha256="0" * 64, renderer="ultragray")
    file.seek(0)
    with np.load(file) as archive:
        found = set(archive)
    table = generator("product").npz()
    assert {code(line)[0] for line in table.splitlines()[2:]} == found


def test_encodings():
    documented = {code(name)[0]: code(kind)[0] for name, kind, _ in rows("frames.md", "Encodings")}
    assert set(documented) == {encoding.value for encoding in Encoding}
    for name, media_type in documented.items():
        dtype = name if media_type == accept.RAW else None
        assert accept.choose(media_type, frames=1, outputs=1, dtype=dtype).encoding is Encoding(name)
    accepted = rows("http.md", "What comes back")
    assert [code(cells[0])[0] for cells in accepted] == list(accept.MEDIA_TYPES)


def test_details_of_grpc_errors():
    told = [status.status_of(cls("no", field="x")) for cls in error_classes()]
    found = {detail.type_url.rpartition("/")[2] for one in told for detail in one.details}
    assert {code(cells[0])[0] for cells in rows("grpc.md", "Errors")} == found


def test_messages_of_openigtlink():
    assert sorted(code(cells[0])[0] for cells in rows("openigtlink.md", "Messages")) == sorted(CAPABILITY)
