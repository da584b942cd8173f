"""Compressed scene files: what they keep, what they may lose, and that damage is told in a sentence."""

import contextlib
import json
import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ultragray import GaussianScene, read_header, render
from ultragray.errors import SceneFileInvalid
from ultragray.geometry.rotations import rotations_of
from ultragray.phantom.demo import DEMO_FILE
from ultragray.scene import compressed

MOST_BYTES = 12
MOST_CHANGE = 5e-3  # of the 99.9th percentile of the pixels
COLUMN_BYTES, HEAD_BYTES = 17, 8


@pytest.fixture(scope="module")
def demo():
    return GaussianScene.load(DEMO_FILE)


@pytest.fixture(scope="module")
def demo_bytes(demo):
    return demo.to_compressed_bytes()


@pytest.fixture
def read(tmp_path):
    def read(data):
        (tmp_path / "scene.ugz").write_bytes(data)
        return GaussianScene.load(tmp_path / "scene.ugz")

    return read


def labelled(count, sh_degree, seed=0):
    """A scene whose Gaussians are told apart by their labels."""
    random = np.random.default_rng(seed)
    splats = {
        "means": random.normal(size=(count, 3)) * (3.0, 1.0, 2.0),
        "scales": random.uniform(-4.5, -1.0, (count, 3)),
        "quats": random.normal(size=(count, 4)) * random.uniform(0.1, 3.0, (count, 1)),
        "transmittances": random.normal(size=count) * 4.0,
        "sh0": random.normal(size=(count, 1, 1)) * 2.0,
        "shN": random.normal(size=(count, (sh_degree + 1) ** 2 - 1, 1)) * 0.1,
    }
    tensors = {name: torch.tensor(values, dtype=torch.float32) for name, values in splats.items()}
    return GaussianScene.from_splats(tensors, labels=torch.arange(1, count + 1, dtype=torch.uint8))


def tensors_of(data):
    """Of a bundle: its header, and each tensor's bytes."""
    begin = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:begin])
    return header, {
        name: data[begin + one["data_offsets"][0] : begin + one["data_offsets"][1]]
        for name, one in header.items()
        if name != "__metadata__"
    }


def replaced_part(data, part):
    """The file with other bytes, of the same number, as its first part."""
    old = tensors_of(data)[1]["part.00"]
    assert len(part) == len(old)
    return data.replace(old, part)


def with_checksum(part):
    return part[:-4] + struct.pack("<I", zlib.crc32(part[:-4]))


def covariances(scales, quats):  # [N, 3] log, [N, 4] -> [N, 3, 3]
    turns = Rotation.from_quat(np.roll(quats, -1, axis=1)).as_matrix()
    return turns @ (np.exp(2.0 * scales)[..., None] * turns.transpose(0, 2, 1))


def test_a_gaussian_of_the_demo_scene_takes_twelve_bytes_and_its_frames_hardly_change(demo, demo_bytes, read):
    found = read(demo_bytes)
    parts = [len(part) for name, part in tensors_of(demo_bytes)[1].items() if name.startswith("part.")]
    assert len(parts) > 1
    assert sum(parts) <= MOST_BYTES * demo.gaussian_count
    poses = demo.training_poses[::25]
    size = {"height": 192, "width": 192, "outputs": ("bmode",)}
    frames = [render(scene, demo.info.probe, poses, **size)["bmode"].numpy() for scene in (demo, found)]
    assert 0.0 < np.percentile(np.abs(frames[0] - frames[1]), 99.9) <= MOST_CHANGE


@given(count=st.integers(1, 255), sh_degree=st.integers(0, 3), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_each_gaussian_is_found_again_within_half_a_step(count, sh_degree, seed):
    scene = labelled(count, sh_degree, seed)
    splats = {name: tensor.numpy() for name, tensor in scene.splats.items()}
    parts = compressed.pack(splats, scene.labels.numpy())
    found = compressed.unpack(parts, count, sh_degree, has_labels=True)
    labels = found["labels"]
    back = np.argsort(labels)
    np.testing.assert_array_equal(labels[back], scene.labels.numpy())
    step = np.exp(np.median(splats["scales"].min(axis=1))) / compressed._MEAN_STEPS
    for name, most in (
        ("means", 0.5 * step),
        ("sh0", 0.5 * compressed._SH0_STEP),
        ("shN", 0.5 * compressed._SHN_STEP),
    ):
        np.testing.assert_allclose(found[name][back], splats[name], atol=1.001 * most + 1e-6)
    clipped = np.clip(splats["transmittances"], *compressed._LOGITS)
    np.testing.assert_allclose(found["transmittances"][back], clipped, atol=0.5 * compressed._LOGIT_STEP)
    before = covariances(splats["scales"].astype(float), splats["quats"].astype(float))
    after = covariances(found["scales"][back].astype(float), found["quats"][back].astype(float))
    size = np.linalg.norm(before, axis=(1, 2))
    assert (np.linalg.norm(before - after, axis=(1, 2)) / size).max() < 0.1


def test_the_least_turned_of_equal_ellipsoids_is_stored():
    scene = labelled(200, 0)
    scales, quats = scene.scales.numpy(), scene.quats.numpy()
    turns, exchanged = compressed._least_turned(quats, scales)
    assert np.abs(turns).max() <= np.sqrt(2.0) - 1.0 + 1e-9
    with_w = np.concatenate([np.ones((200, 1)), turns], axis=1)
    np.testing.assert_allclose(covariances(exchanged, with_w), covariances(scales, quats), rtol=1e-4, atol=1e-6)


def test_poses_description_and_corrections_are_kept_as_they_are(demo, read):
    turns = np.tile(np.eye(4), (len(demo.training_poses), 1, 1))
    turns[:, :3, :3] = rotations_of(np.linspace(0.0, 0.01, 3 * len(turns)).reshape(-1, 3))
    scene = replace(demo, pose_corrections=turns)
    found = read(scene.to_compressed_bytes())
    np.testing.assert_array_equal(found.training_poses, demo.training_poses)
    np.testing.assert_array_equal(found.pose_corrections, turns)
    bounds = {"bounds_min_mm": demo.info.bounds_min_mm, "bounds_max_mm": demo.info.bounds_max_mm}
    assert replace(found.info, **bounds) == demo.info
    np.testing.assert_array_equal(
        torch.bincount(found.labels, minlength=256), torch.bincount(demo.labels, minlength=256)
    )


def test_the_file_says_what_it_is_whatever_its_name(demo, demo_bytes, tmp_path):
    for name, data in (("a.ugr", demo_bytes), ("b.ugz", DEMO_FILE.read_bytes())):
        (tmp_path / name).write_bytes(data)
        header = read_header(tmp_path / name)
        assert header.is_compressed == (name == "a.ugr")
        assert GaussianScene.load(tmp_path / name).gaussian_count == header.info.gaussian_count == demo.gaussian_count
    demo.save(tmp_path / "c.ugz")
    assert (tmp_path / "c.ugz").read_bytes() == demo_bytes


def test_what_is_read_again_from_a_compressed_file_is_an_ordinary_scene(demo_bytes, read, tmp_path):
    found = read(demo_bytes)
    found.save(tmp_path / "again.ugr")
    again = GaussianScene.load(tmp_path / "again.ugr")
    for name, tensor in found.splats.items():
        torch.testing.assert_close(again.splats[name], tensor, rtol=0.0, atol=0.0)


def test_a_file_that_is_cut_anywhere_is_refused(demo_bytes, read):
    for size in (0, 7, 100, 5000, 20_000, len(demo_bytes) // 2, len(demo_bytes) - 1):
        with pytest.raises(SceneFileInvalid) as caught:
            read(demo_bytes[:size])
        assert "\n" not in caught.value.detail


def test_a_changed_byte_is_noticed_wherever_it_lies(read):
    data = labelled(60, 1).to_compressed_bytes()
    whole, begin = read(data), 8 + int.from_bytes(data[:8], "little")
    random = np.random.default_rng(1)

    def changed(place):
        one = bytearray(data)
        one[place] ^= 1 << random.integers(8)
        return read(bytes(one))

    for place in range(begin, len(data)):
        with pytest.raises(
            SceneFileInvalid, match=r"its checksum differs|their checksum differs|its format_version is"
        ):
            changed(place)
    for place in random.integers(8, begin, 200):
        with contextlib.suppress(SceneFileInvalid):  # but for a blank that JSON may have, say
            torch.testing.assert_close(changed(place).means, whole.means, rtol=0.0, atol=0.0)


NAN = struct.pack("<d", float("nan"))


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda part: struct.pack("<I", 0) + part[4:], "part.00 has a head that it cannot have"),
        (lambda part: struct.pack("<I", 61) + part[4:], "part.00 has a head that it cannot have"),
        (lambda part: struct.pack("<I", 59) + part[4:], "part.00 is not of the size that its head says"),
        (lambda part: part[:4] + struct.pack("<I", 99) + part[8:], "part.00 has a head that it cannot have"),
        (lambda part: part[: HEAD_BYTES + 16] + b"\xff" + part[HEAD_BYTES + 17 :], "part.00 has a head that it"),
        (lambda part: part[: HEAD_BYTES + 16] + b"\x04" + part[HEAD_BYTES + 17 :], "part.00 is not of the size"),
        (lambda part: part[:-30] + bytes(30), "part.00 is not of the size that its head says"),
        (lambda part: part[: HEAD_BYTES + COLUMN_BYTES] + NAN + part[HEAD_BYTES + COLUMN_BYTES + 8 :], "'means'"),
    ],
)
def test_a_hostile_part_is_one_sentence(change, problem, read):
    data = labelled(60, 1).to_compressed_bytes()
    part = with_checksum(change(tensors_of(data)[1]["part.00"]))
    with pytest.raises(SceneFileInvalid, match=problem) as caught:
        read(replaced_part(data, part))
    assert "\n" not in caught.value.detail


def test_parts_must_hold_all_gaussians_and_belong_to_a_known_version(read):
    scene = labelled(60, 1)
    data = scene.to_compressed_bytes()
    for old, new, problem in (
        (tensors_of(data)[1]["compressed"], struct.pack("<II", 2, 0), "a newer release wrote it"),
        (b'"part.00"', b'"part.01"', "its tensors are"),
    ):
        assert old in data
        with pytest.raises(SceneFileInvalid, match=problem):
            read(data.replace(old, new))
    parts = compressed.pack({name: tensor.numpy() for name, tensor in scene.splats.items()}, None)
    with pytest.raises(ValueError, match="its parts hold 60 Gaussians, its description says 61"):
        compressed.unpack(parts, 61, 1, has_labels=False)


def test_the_largest_gaussians_come_first():
    random = np.random.default_rng(2)
    splats = {name: tensor.numpy() for name, tensor in labelled(255, 0).splats.items()}
    many = {name: np.concatenate([values] * 20) for name, values in splats.items()}
    many["scales"] = random.uniform(-4.0, -1.0, many["scales"].shape).astype(np.float32)
    parts = compressed.pack(many, None)
    counts = [struct.unpack_from("<I", part)[0] for part in parts]
    assert counts[0] < counts[1] < counts[2]
    assert sum(counts) == len(many["means"])
    volumes = compressed.unpack(parts, sum(counts), 0, has_labels=False)["scales"].sum(axis=1)
    ends = np.cumsum(counts)
    for end in ends[:-1]:
        assert volumes[:end].min() > volumes[end:].max() - 0.1
