"""PLY: a scene comes back to the bit; whatever is no such file is named."""

import os
import re
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch

from ultragray import ElevationBeam, GaussianScene, LinearProbe
from ultragray.errors import SceneFileInvalid
from ultragray.exchange import ply
from ultragray.exchange.ply import read_ply, write_ply
from ultragray.scene.gaussians import PARAMETERS

INFO = {
    "centre_mm": (12.5, -3.25, 0.1),
    "probe": LinearProbe(width_mm=37.9, near_mm=0.0, far_mm=46.4),
    "image_height": 24,
    "image_width": 20,
    "dataset_name": 'A  name with\ttwo  spaces, Ünïcödé, \\ and "quotes" ' + "x" * 300,
    "dataset_sha256": "0" * 64,
    "metrics": {"psnr_db": 29.123456789012345, "gmsd": 1e-300},
    "training": {"preset": "fast", "steps": 400, "nested": [1, None, {"a b": True}]},
}


@pytest.fixture
def make_scene(random_scene, random_poses):
    def make(count=7, *, poses=3, **options):
        made = random_scene(count, **{"info": INFO, **options})
        return GaussianScene.from_splats(made.splats, info=made.info, training_poses=random_poses(poses))

    return make


@pytest.fixture
def file(tmp_path, make_scene):
    path = tmp_path / "scene.ply"
    write_ply(make_scene(), path)
    return path


def change(path, old, new):
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new, 1))


def refused(path, message):
    with pytest.raises(SceneFileInvalid, match=rf"{re.escape(str(path))}: .*{message}") as caught:
        read_ply(path)
    assert "\n" not in caught.value.detail
    assert len(caught.value.detail) < 800


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
@pytest.mark.parametrize("intensity", ["released", "sigmoid"])
def test_a_scene_comes_back_to_the_bit(tmp_path, make_scene, sh_degree, intensity):
    scene = make_scene(sh_degree=sh_degree, intensity=intensity)
    scene = replace(scene, info=replace(scene.info, beam=ElevationBeam(2.5, 30.0, 20.0)))
    write_ply(scene, tmp_path / "a.ply")
    back = read_ply(tmp_path / "a.ply")
    assert back.info == scene.info
    assert back.to_bytes() == scene.to_bytes()


def test_what_other_tools_find(tmp_path, make_scene):
    """Read as any reader of PLY would: by the types and names of the header alone."""
    scene = make_scene()
    write_ply(scene, tmp_path / "a.ply")
    header, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    assert max(map(len, header.splitlines())) < 256
    assert b"cm" in header
    assert re.findall(rb"^element .*$", header, re.MULTILINE) == [b"element vertex 7", b"element training_pose 3"]
    names = re.findall(rb"^property float (\w+)$", header, re.MULTILINE)
    row = dict(zip(names, struct.unpack_from(f"<{len(names)}f", body, 4 * len(names)), strict=True))
    assert row[b"transmittance"] == float(scene.transmittances[1])
    assert [row[b"rot_0"], row[b"scale_2"]] == [float(scene.quats[1, 0]), float(scene.scales[1, 2])]
    assert [row[b"f_dc_0"], row[b"f_rest_2"]] == [float(scene.sh0[1, 0, 0]), float(scene.shN[1, 2, 0])]
    assert [row[b"x"], row[b"y"], row[b"z"]] == scene.means[1].tolist()
    pose = np.frombuffer(body, "<f8", 16, offset=7 * 4 * len(names)).reshape(4, 4)
    np.testing.assert_array_equal(pose, scene.training_poses[0])


def test_a_tool_may_reorder_and_take_gaussians_away(tmp_path, make_scene):
    scene = make_scene()
    write_ply(scene, tmp_path / "a.ply")
    header, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    names = re.findall(r"^property float (\w+)$", header.decode(), re.MULTILINE)
    rows = np.frombuffer(body, "<f4", 7 * len(names)).reshape(7, len(names))
    comments = [line for line in header.decode().splitlines() if line.startswith("comment")]
    lines = ["ply", "format binary_little_endian 1.0", "comment written by another tool", *comments]
    lines += ["obj_info x", "element vertex 4", *(f"property float32 {name}" for name in reversed(names)), "end_header"]
    (tmp_path / "b.ply").write_bytes("\r\n".join([*lines, ""]).encode() + rows[:4, ::-1].tobytes())
    back = read_ply(tmp_path / "b.ply")
    for name in PARAMETERS:
        assert torch.equal(back.splats[name], scene.splats[name][:4])
    assert (back.info.gaussian_count, back.info.probe, len(back.training_poses)) == (4, scene.info.probe, 0)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"ply\n", b"PLY\n", "does not begin like a PLY file"),
        (b"binary_little_endian", b"ascii", "its format is ascii 1.0, expected binary_little_endian 1.0"),
        (b"format binary_little_endian 1.0\n", b"", "its format is missing"),
        (b"property float transmittance\n", b"", "its vertex lacks transmittance"),
        (b"property float opacity\n", b"property float opacity\nproperty float x\n", "its vertex has a property twice"),
        (b"property float opacity\n", b"property float opacity\nproperty float nx\n", "its vertex has nx"),
        (b"property float x\n", b"property double x\n", "its vertex property x is double, expected float"),
        (b"property float x\n", b"property list uchar int x\n", "a line that it cannot have"),
        (b"element vertex 7\n", b"element vertex 8\n", "it is truncated"),
        (b"element vertex 7\n", b"element face 9\nelement vertex 7\n", "it has an element 'face'"),
        (b"element vertex 7\n", b"element vertex 6\n", "longer than its header says"),
        (b"end_header\n", b"", "its header has no end"),
        (b"comment ultragray", b"comment somebody", "not a PLY scene that can be read"),
        (b'"format_version":1', b'"format_version":9', "format_version is 9"),
        (b'"centre_mm":[12.5', b'"centre_mm":[1' + b"0" * 400, "."),
    ],
)
def test_a_wrong_header_is_named(tmp_path, make_scene, monkeypatch, old, new, message):
    path = tmp_path / "scene.ply"
    monkeypatch.setattr(ply, "COMMENT_CHARACTERS", 10_000)
    write_ply(make_scene(intensity="sigmoid"), path)
    change(path, old, new)
    refused(path, message)


def test_a_ply_of_something_else_is_named(tmp_path):
    path = tmp_path / "scene.ply"
    path.write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float x\nend_header\n")
    refused(path, "no comments `ultragray")
    path.write_bytes(b"ply\nformat binary_little_endian 1.0\ncomment ultragray " + b"[" * 200_000 + b"\nend_header\n")
    refused(path, "lacks|elements are|nests too deeply")


def test_values_that_cannot_be_are_named(file):
    content = file.read_bytes()
    body = content.index(b"end_header\n") + len(b"end_header\n")
    file.write_bytes(content[:body] + struct.pack("<f", float("nan")) + content[body + 4 :])
    refused(file, "means.* must be finite")
    file.write_bytes(content[:-8] + struct.pack("<d", 7.0))
    refused(file, r"training_poses\[2\] must end in the row 0 0 0 1")


def test_files_that_are_not_there(tmp_path):
    refused(tmp_path / "none.ply", "no such file")
    refused(tmp_path, "no such file")
    os.mkfifo(tmp_path / "pipe.ply")
    refused(tmp_path / "pipe.ply", "no such file")
