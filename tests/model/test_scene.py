"""GaussianScene and its description: checks, units, and scene files that are truncated, foreign or hostile."""

import copy
import hashlib
import json
import math
import os
import pickle
import struct
import threading

import numpy as np
import pytest
import torch
from safetensors.numpy import save_file
from safetensors.torch import save

from ultragray import (
    ConvexProbe,
    ElevationBeam,
    Frames,
    GaussianScene,
    LinearProbe,
    PhasedProbe,
    SceneInfo,
    read_header,
)
from ultragray.datasets import Dataset, Sweep
from ultragray.errors import InvalidArgument, SceneFileInvalid
from ultragray.files import file_sha256
from ultragray.scene.gaussians import PARAMETERS
from ultragray.scene.info import (
    MAX_HEADER_BYTES,
    MAX_TRAINING_POSES,
    METADATA_KEY,
    SceneHeader,
    expected_shapes,
    info_from_json,
    info_to_json,
    with_summary,
)


def splats(count=4, sh_degree=1):
    return {
        "means": torch.arange(count * 3.0).reshape(count, 3),
        "scales": torch.zeros(count, 3),
        "quats": torch.ones(count, 4),
        "transmittances": torch.zeros(count),
        "sh0": torch.zeros(count, 1, 1),
        "shN": torch.zeros(count, (sh_degree + 1) ** 2 - 1, 1),
    }


def test_a_copy_is_the_same_scene_and_prepares_itself_anew():
    scene = GaussianScene.from_splats(splats(), training_poses=np.eye(4)[None])
    scene.prepared("lock", threading.Lock)  # as backends keep what cannot be copied
    for copied in (copy.deepcopy(scene), pickle.loads(pickle.dumps(scene))):
        assert copied.to_bytes() == scene.to_bytes()
        assert copied.prepared("lock", lambda: "anew") == "anew"


def test_shn_may_be_left_out():
    raw = splats()
    del raw["shN"]
    scene = GaussianScene.from_splats(raw)
    assert scene.sh_degree == 0
    assert scene.shN.shape == (4, 0, 1)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("means", None, "missing means"),
        ("means", torch.zeros(4, 2), r"\[4, 3\], got \[4, 2\]"),
        ("sh0", torch.zeros(4, 1), r"\[4, 1, 1\]"),
        ("shN", torch.zeros(4, 2, 1), "0, 3, 8, 15"),
        ("shN", torch.zeros(4, 3, 3), r"\[4, 3, 1\]"),
        ("scales", torch.zeros(4, 3, dtype=torch.int64), "floating"),
        ("scales", np.zeros((4, 3)), "floating tensor, got ndarray"),
        ("scales", torch.zeros(4, 3, dtype=torch.float64), "float32"),
        ("scales", torch.full((4, 3), float("nan")), "finite"),
        ("scales", torch.tensor([[0.0] * 3, [60.0] * 3, [0.0, -60.0, 0.0], [0.0] * 3]), r"±20, .* Gaussian 1 \(2 are"),
        ("transmittances", torch.full((4,), -1e30), "within ±1e"),
        ("sh0", torch.full((4, 1, 1), 3e38), "within ±1e"),
        ("means", torch.full((4, 3), 2e6), "within ±1e"),
        ("quats", torch.zeros(4, 4), "zero"),
        ("quats", torch.full((4, 4), 1e-30), "zero"),
    ],
)
def test_splats_that_do_not_fit_are_refused_by_name(name, value, message):
    raw = splats()
    if value is None:
        del raw[name]
    else:
        raw[name] = value
    with pytest.raises(InvalidArgument, match=message):
        GaussianScene.from_splats(raw)


def test_splats_hold_a_gaussian():
    with pytest.raises(InvalidArgument, match="at least one Gaussian"):
        GaussianScene.from_splats(splats(0))


def test_a_file_brings_everything_back(tmp_path, random_scene, random_poses):
    info = {"centre_mm": (1.5, -2.0, 3.0), "probe": LinearProbe(40.0, 0.0, 50.0), "metrics": {"psnr_db": 26.9}}
    made = random_scene(11, sh_degree=3, intensity="sigmoid", info=info)
    scene = GaussianScene.from_splats(made.splats, info=made.info, training_poses=random_poses(5))
    path = tmp_path / "a.ugr"
    scene.save(path)
    back = GaussianScene.load(path)
    assert back.info == scene.info
    np.testing.assert_allclose(back.training_poses, scene.training_poses, atol=1e-12)
    for name in PARAMETERS:
        assert torch.equal(back.splats[name], scene.splats[name])


def test_equal_scenes_have_equal_files_and_the_hash_is_of_the_file(tmp_path, random_scene):
    first, second = tmp_path / "a.ugr", tmp_path / "b.ugr"
    random_scene(5).save(first)
    random_scene(5).to(torch.float64).save(second)
    assert first.read_bytes() == second.read_bytes()
    assert file_sha256(first) == hashlib.sha256(first.read_bytes()).hexdigest()


class Hostile:
    def __reduce__(self):
        return os.system, ("touch pwned",)


def bundle(change=lambda _: None, info=None):
    tensors = {**splats(), "training_poses": torch.zeros(0, 4, 4, dtype=torch.float64)}
    change(tensors)
    scene = GaussianScene.from_splats(splats())
    return save(tensors, metadata={METADATA_KEY: info_to_json(scene.info) if info is None else info})


def metadata(**changes):
    return json.dumps({**json.loads(info_to_json(GaussianScene.from_splats(splats()).info)), **changes})


BAD_FILES = {
    "empty": b"",
    "text": b"not a scene at all, just text that goes on for a while",
    "pickle": pickle.dumps({"splats": Hostile()}),
    "truncated": bundle()[:-10],
    "cut_in_the_header": bundle()[:60],
    "trailing_bytes": bundle() + b"\0" * 8,
    "header_longer_than_the_file": struct.pack("<Q", 1 << 60) + b"{}",
    "foreign_safetensors": save({"weight": torch.zeros(3)}),
    "metadata_not_json": bundle(info="{"),
    "metadata_no_object": bundle(info="[]"),
    "metadata_nests": bundle(info="[" * 100_000),
    "other_version": bundle(info=metadata(format_version=99)),
    "wrong_count": bundle(info=metadata(gaussian_count=5)),
    "no_gaussians": bundle(lambda tensors: tensors.update(splats(0)), info=metadata(gaussian_count=0)),
    "far_centre": bundle(info=metadata(centre_mm=[1e308, 0.0, 0.0])),
    "nan_in_the_metadata": bundle(info=metadata(training={"loss": math.nan})),
    "metrics_of_text": bundle(info=metadata(metrics={"psnr_db": "30"})),
    "metrics_of_many_digits": bundle(info=metadata(metrics={"psnr_db": 10**400})),
    "huge_count": bundle(info=metadata(gaussian_count=10**18)),
    "degree_beyond": bundle(info=metadata(sh_degree=400)),
    "bad_probe": bundle(info=metadata(probe={"kind": "linear", "width_mm": -1, "near_mm": 0, "far_mm": 1})),
    "missing_tensor": bundle(lambda t: t.__delitem__("quats")),
    "surplus_tensor": bundle(lambda t: t.update(extra=torch.zeros(1))),
    "wrong_shape": bundle(lambda t: t.update(means=torch.zeros(4, 2))),
    "wrong_dtype": bundle(lambda t: t.update(means=torch.zeros(4, 3, dtype=torch.float64))),
    "bad_pose": bundle(lambda t: t.update(training_poses=torch.zeros(1, 4, 4, dtype=torch.float64))),
}
BAD_VALUES = {
    "nan": bundle(lambda t: t.update(means=torch.full((4, 3), float("nan")))),
    "zero_quaternion": bundle(lambda t: t.update(quats=torch.zeros(4, 4))),
}


def test_a_file_of_values_that_no_scene_has_is_refused(tmp_path):
    path = tmp_path / "a.ugr"
    path.write_bytes(bundle(lambda tensors: tensors.update(scales=torch.full((4, 3), 1000.0))))
    with pytest.raises(SceneFileInvalid, match=r"a\.ugr: .*'scales'.* must be finite and within ±20, got .*Gaussian 0"):
        GaussianScene.load(path)


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_bad_file_gives_one_clear_error(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / f"{name}.ugr"
    path.write_bytes(BAD_FILES[name])
    for read in (GaussianScene.load, read_header):
        with pytest.raises(SceneFileInvalid, match=f"{name}.ugr: ") as caught:
            read(path)
        assert "\n" not in caught.value.detail
        assert len(caught.value.detail) < 1000
    assert not (tmp_path / "pwned").exists()


@pytest.mark.parametrize("name", BAD_VALUES)
def test_bad_values_are_found_on_loading(name, tmp_path):
    path = tmp_path / f"{name}.ugr"
    path.write_bytes(BAD_VALUES[name])
    with pytest.raises(SceneFileInvalid, match=f"{name}.ugr: "):
        GaussianScene.load(path)


def test_a_missing_file_and_a_folder(tmp_path):
    with pytest.raises(SceneFileInvalid, match="no such file"):
        GaussianScene.load(tmp_path / "absent.ugr")
    with pytest.raises(SceneFileInvalid):
        GaussianScene.load(tmp_path)


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
        ({"centre_mm": [1, 2, float("inf")]}, "its metadata holds Infinity"),
        ({"intensity": "linear"}, "released, sigmoid"),
        ({"training": None}, "training must be an object"),
        ({"label_names": {"0": "nothing"}}, "label_names must give labels from 1 to 255 a name each"),
        ({"beam": {"thickness_mm": -1.0}}, "thickness_mm must be a finite number from 0"),
        ({"beam": {"thickness_mm": 1.0, "focus_mm": 9.0}}, "depth_of_field_mm must be given"),
        ({"beam": {"thickness_mm": 1.0, "depth_of_field_mm": 9.0}}, "focus_mm must be given"),
        ({"probe": {"kind": "linear"}}, "width_mm is required by the probe linear"),
    ],
)
def test_a_wrong_entry_is_named(change, message):
    document = {**json.loads(info_to_json(FULL)), **change}
    with pytest.raises(ValueError, match=message):
        info_from_json(json.dumps(document))


def test_the_summary_is_in_the_frame_of_the_sweep():
    info = with_summary(SceneInfo(centre_mm=(100.0, 0.0, -50.0)), np.array([[1.0, 2, 3], [-1, 0, 5]]), 1)
    assert info.gaussian_count == 2
    assert info.sh_degree == 1
    assert info.bounds_min_mm == (90.0, 0.0, -20.0)
    assert info.bounds_max_mm == (110.0, 20.0, 0.0)
    empty = with_summary(SceneInfo(centre_mm=(1.0, 2.0, 3.0)), np.zeros((0, 3)), 0)
    assert empty.bounds_min_mm == empty.bounds_max_mm == (1.0, 2.0, 3.0)


def test_a_header_is_read_alone(tmp_path, random_scene, random_poses):
    scene = random_scene(9, sh_degree=2, info={"centre_mm": (1.0, 2.0, 3.0), "dataset_name": "x"})
    poses = random_poses(4)
    path = tmp_path / "a.ugr"
    GaussianScene.from_splats(scene.splats, info=scene.info, training_poses=poses).save(path)
    header = read_header(path)
    assert header.info == scene.info
    assert header.file_bytes == path.stat().st_size
    np.testing.assert_allclose(header.training_poses, poses, atol=1e-12)


def write_one_gaussian(path, poses, **more_metadata):
    tensors = {name: np.zeros(shape, np.float32) for name, shape in expected_shapes(1, 0).items()}
    tensors["training_poses"] = np.tile(np.eye(4), (poses, 1, 1))
    save_file(tensors, path, {"ultragray": info_to_json(SceneInfo(gaussian_count=1)), **more_metadata})


def test_a_description_has_limits(tmp_path):
    path = tmp_path / "large.ugr"
    write_one_gaussian(path, MAX_TRAINING_POSES)
    assert len(read_header(path).training_poses) == MAX_TRAINING_POSES
    write_one_gaussian(path, MAX_TRAINING_POSES + 1)
    with pytest.raises(SceneFileInvalid, match="training_poses must be at most 100000, got 100001"):
        read_header(path)
    write_one_gaussian(path, 1, more="x" * MAX_HEADER_BYTES)
    with pytest.raises(SceneFileInvalid, match="may have 4194304 bytes, it says 419"):
        read_header(path)
    with pytest.raises(InvalidArgument, match="at most 1000 entries, got 1001"):
        SceneInfo(metrics={str(number): 1.0 for number in range(1001)})


def test_what_is_over_a_limit_is_not_read(tmp_path):
    path = tmp_path / "sparse.ugr"
    write_one_gaussian(path, 0)
    length = int.from_bytes(path.read_bytes()[:8], "little")
    header = json.loads(path.read_bytes()[8 : 8 + length])
    metadata, nothing, end = header.pop("__metadata__"), 1 << 36, 0
    for entry in header.values():  # after 64 GiB of nothing
        entry["data_offsets"] = [nothing + offset for offset in entry["data_offsets"]]
        end = max(end, entry["data_offsets"][1])
    header["training_poses"] = {"dtype": "F64", "shape": [1 << 29, 4, 4], "data_offsets": [0, nothing]}
    text = json.dumps({**header, "__metadata__": metadata}).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text)
    os.truncate(path, 8 + len(text) + end)
    with pytest.raises(SceneFileInvalid, match="training_poses must be at most"):
        read_header(path)


def test_a_scene_that_could_not_be_read_again_is_not_made(random_scene):
    scene = random_scene(3)
    with pytest.raises(InvalidArgument, match="training_poses must be at most"):
        GaussianScene.from_splats(scene.splats, training_poses=np.tile(np.eye(4), (MAX_TRAINING_POSES + 1, 1, 1)))
    with pytest.raises(InvalidArgument, match="header of a scene file"):
        random_scene(3, info={"training": {"text": "x" * MAX_HEADER_BYTES}}).to_bytes()


PROBE = LinearProbe(40.0, 0.0, 50.0)
IN_WORDS = "linear probe (width 40 mm, near 0 mm, far 50 mm)"


def test_what_is_shown_of_scenes_and_sweeps(random_scene):
    assert repr(Frames({"bmode": torch.zeros(8, 512, 256)})) == "Frames(8 of 512x256: bmode)"
    assert repr(random_scene(1200)) == "GaussianScene(1,200 Gaussians, no probe)"
    scene = random_scene(60, info={"probe": PROBE, "dataset_name": "liver"})
    assert repr(scene) == f"GaussianScene('liver', 60 Gaussians, {IN_WORDS})"
    header = repr(SceneHeader(scene.info, np.zeros((3, 4, 4)), 10, np.zeros((3, 4, 4))))
    assert header.endswith("file_bytes=10)")
    assert "array" not in header
    images = np.random.default_rng(0).integers(0, 250, (10, 20, 16), dtype=np.uint8)
    sweep = Sweep(images, np.tile(np.eye(4), (10, 1, 1)), PROBE, np.arange(10), "scan.mha")
    assert repr(sweep) == f"Sweep(10 frames of 20x16, {IN_WORDS}, 'scan.mha')"
    assert "array" not in repr(Dataset("liver", sweep, sweep.select([1])))
