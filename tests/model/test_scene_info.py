"""The scene's own description: JSON round trip, limits, and headers that are read without torch."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from ultragray import ConvexProbe, ElevationBeam, GaussianScene, LinearProbe, PhasedProbe, SceneInfo, read_header
from ultragray.errors import InvalidArgument, SceneFileInvalid
from ultragray.scene.info import (
    MAX_HEADER_BYTES,
    MAX_TRAINING_POSES,
    expected_shapes,
    info_from_json,
    info_to_json,
    with_summary,
)

FULL = SceneInfo(
    centre_mm=(1.0, 2.0, 3.0),
    probe=ConvexProbe(opening_angle_deg=60.0, near_mm=50.0, far_mm=200.0),
    image_height=256,
    image_width=192,
    intensity="sigmoid",
    sh_degree=2,
    gaussian_count=7,
    bounds_min_mm=(-1.0, -2.0, -3.0),
    bounds_max_mm=(4.0, 5.0, 6.0),
    dataset_name="Leber “links”",
    dataset_sha256="ab" * 32,
    metrics={"psnr_db": 26.9},
    training={"steps": 30000, "nested": {"rates": [1, 2]}},
)


OTHERS = (
    SceneInfo(),
    SceneInfo(probe=LinearProbe(40.0, 0.0, 50.0)),
    SceneInfo(probe=PhasedProbe(90.0, 120.0)),
    SceneInfo(label_names={1: "bone", 10: "vessel", 2: "muscle"}),
    SceneInfo(beam=ElevationBeam(thickness_mm=2.5, focus_mm=30.0, depth_of_field_mm=20.0)),
)


@pytest.mark.parametrize("info", [FULL, *OTHERS])
def test_json_round_trip(info):
    assert info_from_json(info_to_json(info)) == info


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format_version": 2}, "format_version is 2"),
        ({"surprise": 1}, r"unknown keys \['surprise'\]"),
        ({"centre_mm": [1, 2]}, "centre_mm must be a list of 3 values"),
        ({"centre_mm": [1, 2, float("inf")]}, r"centre_mm\[2\] must be a finite number"),
        ({"intensity": "linear"}, "released, sigmoid"),
        ({"image_height": 0}, "image_height must be an integer of at least 1"),
        ({"training": None}, "training must be an object"),
        ({"label_names": {"0": "nothing"}}, "label_names must give labels from 1 to 255 a name each"),
        ({"beam": {"thickness_mm": -1.0}}, "thickness_mm must be a finite number from 0"),
        ({"beam": {"thickness_mm": 1.0, "focus_mm": 9.0}}, "depth_of_field_mm must be given"),
        ({"probe": {"kind": "linear"}}, "width_mm is required by kind linear"),
    ],
)
def test_a_wrong_entry_is_named(change, message):
    document = {**json.loads(info_to_json(FULL)), **change}
    with pytest.raises(ValueError, match=message):
        info_from_json(json.dumps(document))


@pytest.mark.parametrize("text", ["", "[]", "null", "{", '{"format_version": 1,}'])
def test_other_text_is_refused(text):
    with pytest.raises(ValueError, match=r"."):
        info_from_json(text)


def test_a_scene_without_a_beam_keeps_its_bytes():
    assert "beam" not in json.loads(info_to_json(SceneInfo()))


def test_nan_cannot_be_written():
    with pytest.raises(ValueError, match="JSON"):
        info_to_json(SceneInfo(metrics={"psnr_db": float("nan")}))
    with pytest.raises(InvalidArgument, match=r"centre_mm\[1\] must be a finite number"):
        SceneInfo(centre_mm=(0.0, float("nan"), 0.0))


def test_the_summary_is_in_the_frame_of_the_sweep():
    info = with_summary(SceneInfo(centre_mm=(100.0, 0.0, -50.0)), np.array([[1.0, 2, 3], [-1, 0, 5]]), 1)
    assert info.gaussian_count == 2
    assert info.sh_degree == 1
    assert info.bounds_min_mm == (90.0, 0.0, -20.0)
    assert info.bounds_max_mm == (110.0, 20.0, 0.0)
    empty = with_summary(SceneInfo(centre_mm=(1.0, 2.0, 3.0)), np.zeros((0, 3)), 0)
    assert empty.bounds_min_mm == empty.bounds_max_mm == (1.0, 2.0, 3.0)


def test_a_header_is_read_without_torch(tmp_path, random_scene, random_poses):
    scene = random_scene(9, sh_degree=2, info={"centre_mm": (1.0, 2.0, 3.0), "dataset_name": "x"})
    poses = random_poses(4)
    path = tmp_path / "a.ugr"
    GaussianScene.from_splats(scene.splats, info=scene.info, training_poses=poses).save(path)
    header = read_header(path)
    assert header.info == scene.info
    assert header.file_bytes == path.stat().st_size
    np.testing.assert_allclose(header.training_poses, poses, atol=1e-12)
    program = (
        "import sys, ultragray; "
        f"print(ultragray.read_header({str(path)!r}).info.gaussian_count, 'torch' in sys.modules)"
    )
    model = Path(sys.modules["ultragray"].__file__ or "").parents[1]
    answer = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, env={"PYTHONPATH": str(model)}
    )
    assert answer.stdout.split() == ["9", "False"]


def write_without_gaussians(path, poses, **more_metadata):
    tensors = {name: np.zeros(shape, np.float32) for name, shape in expected_shapes(0, 0).items()}
    tensors["training_poses"] = np.tile(np.eye(4), (poses, 1, 1))
    save_file(tensors, path, {"ultragray": info_to_json(SceneInfo()), **more_metadata})


def test_a_file_of_another_kind_is_told_to_be_one(tmp_path):
    path = tmp_path / "thesis.ugr"
    path.write_bytes(b"%PDF-1.7\n and so on")
    with pytest.raises(SceneFileInvalid, match="it does not begin as a scene file does: it is damaged, or a file of"):
        read_header(path)


def test_a_description_has_limits(tmp_path):
    path = tmp_path / "large.ugr"
    write_without_gaussians(path, MAX_TRAINING_POSES)
    assert len(read_header(path).training_poses) == MAX_TRAINING_POSES
    write_without_gaussians(path, MAX_TRAINING_POSES + 1)
    with pytest.raises(SceneFileInvalid, match="training_poses must be at most 100000, got 100001"):
        read_header(path)
    write_without_gaussians(path, 1, more="x" * MAX_HEADER_BYTES)
    with pytest.raises(SceneFileInvalid, match="may have 4194304 bytes, it says 419"):
        read_header(path)
    with pytest.raises(InvalidArgument, match="at most 1000 entries, got 1001"):
        SceneInfo(metrics={str(number): 1.0 for number in range(1001)})


def test_what_is_over_a_limit_is_not_read(tmp_path):
    path = tmp_path / "sparse.ugr"
    write_without_gaussians(path, 0)
    length = int.from_bytes(path.read_bytes()[:8], "little")
    header = json.loads(path.read_bytes()[8 : 8 + length])
    header["training_poses"] = {"dtype": "F64", "shape": [1 << 29, 4, 4], "data_offsets": [0, 1 << 36]}
    text = json.dumps(header).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text)
    os.truncate(path, 8 + len(text) + (1 << 36))  # 64 GiB of nothing
    with pytest.raises(SceneFileInvalid, match="training_poses must be at most"):
        read_header(path)


def test_a_scene_that_could_not_be_read_again_is_not_made(random_scene):
    scene = random_scene(3)
    with pytest.raises(InvalidArgument, match="training_poses must be at most"):
        GaussianScene.from_splats(scene.splats, training_poses=np.tile(np.eye(4), (MAX_TRAINING_POSES + 1, 1, 1)))
    with pytest.raises(InvalidArgument, match="header of a scene file"):
        random_scene(3, info={"training": {"text": "x" * MAX_HEADER_BYTES}}).to_bytes()
