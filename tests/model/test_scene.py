"""GaussianScene: checks, units, and scene files that are truncated, foreign or hostile."""

import copy
import hashlib
import json
import os
import pickle
import struct
import threading

import numpy as np
import pytest
import torch
from safetensors.torch import save

from ultragray import GaussianScene, LinearProbe, SceneInfo, read_header
from ultragray.errors import InvalidArgument, SceneFileInvalid
from ultragray.files import file_sha256
from ultragray.scene.gaussians import PARAMETERS
from ultragray.scene.info import METADATA_KEY, info_to_json


def splats(count=4, sh_degree=1):
    return {
        "means": torch.arange(count * 3.0).reshape(count, 3),
        "scales": torch.zeros(count, 3),
        "quats": torch.ones(count, 4),
        "transmittances": torch.zeros(count),
        "sh0": torch.zeros(count, 1, 1),
        "shN": torch.zeros(count, (sh_degree + 1) ** 2 - 1, 1),
    }


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_degree_follows_from_the_coefficients(degree):
    scene = GaussianScene.from_splats(splats(sh_degree=degree))
    assert (scene.sh_degree, scene.gaussian_count) == (degree, 4)


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
        ("sh0", None, "missing sh0"),
        ("means", torch.zeros(4, 2), r"\[4, 3\], got \[4, 2\]"),
        ("means", torch.tensor(0.0), "shape"),
        ("sh0", torch.zeros(4, 1), r"\[4, 1, 1\]"),
        ("shN", torch.zeros(4, 2, 1), "0, 3, 8, 15"),
        ("shN", torch.zeros(4, 3, 3), r"\[4, 3, 1\]"),
        ("scales", torch.zeros(4, 3, dtype=torch.int64), "floating"),
        ("scales", np.zeros((4, 3)), "floating tensor, got ndarray"),
        ("scales", torch.zeros(4, 3, dtype=torch.float64), "float32"),
        ("scales", torch.full((4, 3), float("nan")), "finite"),
        ("quats", torch.zeros(4, 4), "zero"),
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


def test_poses_go_from_the_sweep_in_mm_to_the_scene_in_cm():
    scene = GaussianScene.from_splats(splats(), info=SceneInfo(centre_mm=(100.0, 0.0, -50.0)))
    pose = np.eye(4)[None].copy()
    pose[0, :3, 3] = (110.0, 5.0, -50.0)
    inside = scene.poses_to_scene_cm(pose)
    np.testing.assert_allclose(inside[0, :3, 3], (1.0, 0.5, 0.0))
    assert pose[0, 0, 3] == 110.0


def test_to_changes_the_dtype_of_every_tensor_and_nothing_else():
    scene = GaussianScene.from_splats(splats(), info=SceneInfo(dataset_name="x"), training_poses=np.eye(4))
    double = scene.to(torch.float64)
    assert {t.dtype for t in double.splats.values()} == {torch.float64}
    assert double.info == scene.info
    assert len(double.training_poses) == 1


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


@pytest.mark.parametrize("count", [0, 1])
def test_small_scenes_have_files_too(tmp_path, count):
    path = tmp_path / "a.ugr"
    GaussianScene.from_splats(splats(count)).save(path)
    assert GaussianScene.load(path).gaussian_count == count


def test_equal_scenes_have_equal_files_and_the_hash_is_of_the_file(tmp_path, random_scene):
    first, second = tmp_path / "a.ugr", tmp_path / "b.ugr"
    random_scene(5).save(first)
    random_scene(5).to(torch.float64).save(second)
    assert first.read_bytes() == second.read_bytes()
    assert file_sha256(first) == hashlib.sha256(first.read_bytes()).hexdigest()


def test_saving_to_nowhere_is_an_os_error(tmp_path):
    with pytest.raises(OSError, match="nowhere"):
        GaussianScene.from_splats(splats()).save(tmp_path / "nowhere" / "a.ugr")


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
    "metadata_nests": bundle(info="[" * 100_000),
    "other_version": bundle(info=metadata(format_version=99)),
    "wrong_count": bundle(info=metadata(gaussian_count=5)),
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
