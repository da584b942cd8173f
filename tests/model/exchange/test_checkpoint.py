"""Import of released checkpoints: place, scale and depth grid come out right, everything wrong is named."""

import json
import math
import os
import pickle
import zipfile

import numpy as np
import pytest
import torch

from ultragray import GaussianScene, LinearProbe, render
from ultragray.errors import CheckpointInvalid, InvalidArgument, InvalidPose
from ultragray.exchange.checkpoint import import_checkpoint
from ultragray.exchange.poses import load_poses
from ultragray.scene.gaussians import PARAMETERS

LINEAR_CONF = {
    "images_file_train": "data/set/images_train.npy",
    "ultrasound_near_plane": 0.5,
    "ultrasound_far_plane": 4.5,
    "ultrasound_opening_width": 3.0,
    "_comment": "ignored",
    "result_dir": "ignored too",
}
HEIGHT, WIDTH = 9, 7


class Dataset:
    """A dataset in the released layout, under tmp/data/set, and a checkpoint beside it."""

    def __init__(self, root, random_poses, random_scene):
        self.folder = root / "data" / "set"
        self.folder.mkdir(parents=True)
        self.config = self.folder / "conf.json"
        self.images = self.folder / "images_train.npy"
        self.poses = self.folder / "poses_train.npy"
        self.checkpoint = root / "ckpt_29999.pt"
        self.pose_array = random_poses(5, seed=1, shift_mm=100.0)
        self.splats = random_scene(20).splats
        self.write_config()
        np.save(self.images, np.zeros((5, HEIGHT, WIDTH), np.uint8))
        np.save(self.poses, self.pose_array)
        torch.save({"step": 29999, "global_tic": 1.5, "splats": self.splats}, self.checkpoint)

    def write_config(self, **changes):
        document = {**LINEAR_CONF, **changes}
        self.config.write_text(json.dumps({k: v for k, v in document.items() if v is not None}))

    def import_it(self, **options):
        if not {"poses", "center_mm", "centered"} & set(options):
            options["poses"] = self.poses
        return import_checkpoint(self.checkpoint, config=self.config, **options)


@pytest.fixture
def dataset(tmp_path, random_poses, random_scene):
    return Dataset(tmp_path, random_poses, random_scene)


@pytest.mark.parametrize("name", ["g06_ckpt_29999.pt", "g06_ckpt_29999_cuda0.pt"])
def test_both_released_forms_hold_the_golden_scene(golden_folder, dataset, name):
    dataset.checkpoint = golden_folder / name
    scene = dataset.import_it()
    with np.load(golden_folder / "g06.npz") as arrays:
        for parameter in PARAMETERS:
            tensor = scene.splats[parameter]
            assert tensor.device.type == "cpu"
            np.testing.assert_array_equal(tensor.numpy(), arrays[parameter])
    assert scene.info.training == {"imported_from": name, "step": 29999, "released_far_mm": 45.0}


@pytest.mark.parametrize("name", ["spine_phantom", "liver_convex", "ultranerf_liver", "nwire_phantom"])
def test_the_real_datasets_place_a_checkpoint(golden_folder, data_folder, name):
    folder = data_folder / name
    scene = import_checkpoint(
        golden_folder / "g06_ckpt_29999.pt", config=folder / "conf.json", poses=folder / "poses_train.npy"
    )
    conf = json.loads((folder / "conf.json").read_text())
    near, far = 10 * conf["ultrasound_near_plane"], 10 * conf["ultrasound_far_plane"]
    poses = np.load(folder / "poses_train.npy")
    corners = []
    for pose in poses:
        for depth in (near, far):
            if "ultrasound_opening_width" in conf:
                half = 5 * conf["ultrasound_opening_width"]
                local = [(-half, 0, depth), (half, 0, depth)]
            else:
                half = math.radians(conf["ultrasound_opening_angle"]) / 2
                local = [(depth * math.sin(t), 0, depth * math.cos(t)) for t in (-half, 0, half)]
            corners += [pose[:3, :3] @ corner + pose[:3, 3] for corner in local]
    np.testing.assert_allclose(scene.info.centre_mm, np.mean(corners, axis=0), atol=1e-3)
    height, width = np.load(folder / "images_train.npy", mmap_mode="r").shape[1:]
    assert (scene.info.image_height, scene.info.image_width) == (height, width)
    assert scene.info.dataset_name == name
    assert scene.info.probe.near_mm == pytest.approx(near)
    assert scene.info.probe.far_mm == pytest.approx(near + (far - near) * height / (height - 1))
    assert len(scene.training_poses) == len(poses)


def test_a_tracker_pose_shows_what_the_released_view_shows(dataset):
    """A pose in mm in the tracker's frame equals the released pose: cm, minus the centre, on the released grid."""
    scene = dataset.import_it()
    assert scene.info.probe is not None
    ours = render(scene, None, dataset.pose_array, height=HEIGHT, width=WIDTH, backend="reference").bmode
    bare = GaussianScene.from_splats(dataset.splats)
    centred = dataset.pose_array.copy()
    centred[:, :3, 3] -= scene.info.centre_mm
    probe = LinearProbe(width_mm=30.0, near_mm=5.0, far_mm=5.0 + 40.0 * HEIGHT / (HEIGHT - 1))
    released = render(bare, probe, centred, height=HEIGHT, width=WIDTH, backend="reference").bmode
    assert released is not None
    torch.testing.assert_close(ours, released, atol=1e-5, rtol=0)


def test_a_bare_splats_dictionary_and_other_dtypes_load(dataset):
    torch.save({name: t.double() for name, t in dataset.splats.items()}, dataset.checkpoint)
    scene = dataset.import_it()
    assert scene.means.dtype == torch.float32
    assert torch.equal(scene.means, dataset.splats["means"])
    assert "step" not in scene.info.training


def test_the_old_torch_format_loads(dataset):
    torch.save({"step": 7, "splats": dataset.splats}, dataset.checkpoint, _use_new_zipfile_serialization=False)
    assert dataset.import_it().info.training["step"] == 7


def test_a_center_or_centered_instead_of_poses(dataset):
    scene = dataset.import_it(center_mm=(1.0, -2.0, 3.5))
    assert scene.info.centre_mm == (1.0, -2.0, 3.5)
    assert len(scene.training_poses) == 0
    assert dataset.import_it(centered=True).info.centre_mm == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    "options", [{"poses": None}, {"poses": "p.npy", "centered": True}, {"center_mm": (0, 0, 0), "centered": True}]
)
def test_exactly_one_place_must_be_given(dataset, options):
    with pytest.raises(InvalidArgument, match=r"exactly one of poses .* center_mm .* centered"):
        dataset.import_it(**options)


@pytest.mark.parametrize("center", [(0, 0), (0, 0, math.nan), ("a", 0, 0), 5.0])
def test_a_center_that_is_no_point_is_refused(dataset, center):
    with pytest.raises(InvalidArgument, match="center_mm must be"):
        dataset.import_it(center_mm=center)


def test_images_are_found_beside_the_config_and_from_the_folder_of_data(dataset):
    assert dataset.import_it().info.image_height == HEIGHT
    dataset.write_config(images_file_train="elsewhere/on/another/machine/images_train.npy")
    assert dataset.import_it().info.image_height == HEIGHT
    moved = dataset.folder.parent / "images_other.npy"
    dataset.images.rename(moved)
    dataset.write_config(images_file_train="data/images_other.npy")
    assert dataset.import_it().info.image_width == WIDTH


def test_the_image_height_can_be_given(dataset):
    dataset.images.unlink()
    with pytest.raises(InvalidArgument, match=r"image_height must be given.*images_train\.npy.*not found"):
        dataset.import_it()
    scene = dataset.import_it(image_height=101)
    assert (scene.info.image_height, scene.info.image_width) == (101, None)
    assert scene.info.probe.far_mm == pytest.approx(5 + 40 * 101 / 100)
    dataset.write_config(images_file_train=None)
    with pytest.raises(InvalidArgument, match=r"image_height must be given.*names no images_file_train"):
        dataset.import_it()


def test_a_config_may_name_the_image_size_itself(dataset):
    dataset.write_config(image_height=101, image_width=1)
    scene = dataset.import_it()
    assert (scene.info.image_height, scene.info.image_width) == (101, 1)
    assert scene.info.probe.far_mm == pytest.approx(5 + 40 * 101 / 100)
    assert dataset.import_it(image_height=51).info.image_height == 51
    dataset.images.unlink()
    assert dataset.import_it().info == scene.info


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ultrasound_opening_width": None}, "exactly one of .*, got neither"),
        ({"ultrasound_near_plane": None}, "lacks ultrasound_near_plane"),
        ({"ultrasound_far_plane": 0.25}, "far_mm must be greater"),
        ({"ultrasound_far_plane": "4.5"}, "ultrasound_far_plane must be a finite number"),
        ({"images_file_train": 5}, "images_file_train must be a path"),
        ({"image_height": 1}, "image_height must be an integer of at least 2, got 1"),
    ],
)
def test_a_wrong_config_is_named(dataset, changes, message):
    dataset.write_config(**changes)
    with pytest.raises(CheckpointInvalid, match=rf"conf\.json: .*{message}"):
        dataset.import_it()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"{", "not JSON"),
        (b"[]", "JSON object"),
        (b"[" * 200_000, "nests too deeply"),
        (b" " * (1 << 21), "too large"),
    ],
)
def test_a_hostile_config_is_named(dataset, content, message):
    dataset.config.write_bytes(content)
    with pytest.raises(CheckpointInvalid, match=rf"conf\.json: .*{message}"):
        dataset.import_it()
    dataset.config.unlink()
    with pytest.raises(CheckpointInvalid, match=r"conf\.json: no such file"):
        dataset.import_it()


@pytest.mark.parametrize("named", ["/dev/zero", "x" * 5000, "a\0b", "", "."])
def test_a_config_cannot_make_the_importer_read_anything_odd(dataset, named):
    dataset.write_config(images_file_train=named)
    with pytest.raises(InvalidArgument, match="image_height must be given"):
        dataset.import_it()


@pytest.mark.parametrize(
    "write",
    [
        lambda path: np.save(path, np.zeros((5, 9), np.uint8)),
        lambda path: np.save(path, np.array([{}]), allow_pickle=True),
        lambda path: path.write_bytes(b"\x93NUMPY truncated"),
    ],
)
def test_bad_images_are_named(dataset, write):
    write(dataset.images)
    with pytest.raises(CheckpointInvalid, match=r"images_train\.npy: "):
        dataset.import_it()


def test_poses_may_be_rows_of_three_or_json(dataset, tmp_path):
    expected = dataset.import_it()
    np.save(dataset.poses, dataset.pose_array[:, :3].astype(np.float32))
    np.testing.assert_allclose(dataset.import_it().info.centre_mm, expected.info.centre_mm, atol=1e-4)
    text = tmp_path / "poses.json"
    text.write_text(json.dumps(dataset.pose_array.tolist()))
    assert dataset.import_it(poses=text).info.centre_mm == pytest.approx(expected.info.centre_mm)
    text.write_text(json.dumps(dataset.pose_array[0, :3].tolist()))
    assert load_poses(text).shape == (1, 4, 4)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("p.npy", pickle.dumps([1]), "not a file of poses"),
        ("p.json", b"[[1, 2]]", "shape"),
        ("p.json", b'{"poses": []}', r"must hold a list of lists of numbers, .* not \{\"poses\": \[\]\}"),
        ("p.json", b"[" * 200_000, "nests too deeply"),
        ("p.txt", b"1 0 0 0", r"\.npy, \.json and \.mcap"),
        ("p.npy", np.zeros((0, 4, 4)), "no poses"),
        ("p.npy", np.stack([np.eye(4), np.diag([1.0, 1, -1, 1])]), r"poses\[1\] .*mirrored"),
    ],
)
def test_bad_poses_are_named(dataset, tmp_path, name, content, message):
    path = tmp_path / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        np.save(path, content)
    with pytest.raises(CheckpointInvalid, match=f"{name}: .*{message}"):
        dataset.import_it(poses=path)
    with pytest.raises(InvalidPose, match=message):
        load_poses(path)


class Hostile:
    def __reduce__(self):
        return os.system, ("touch pwned",)


def views_that_claim(count):
    """Tensors of `count` Gaussians over one number each."""
    shapes = {"means": (3,), "scales": (3,), "quats": (4,), "transmittances": (), "sh0": (1, 1), "shN": (3, 1)}
    return {name: torch.ones(1).expand(count, *shape) for name, shape in shapes.items()}


BAD_DOCUMENTS = {
    "code": ({"splats": Hostile()}, "refused.*could run code.*system"),
    "code_beside": ({"splats": torch.zeros(1), "x": Hostile()}, "refused.*could run code"),
    "list": ([1, 2], "holds a list"),
    "tensor": (torch.zeros(3), "holds a Tensor"),
    "other_model": ({"model": {"weight": torch.zeros(3)}}, "lack means"),
    "no_splats": ({"splats": None}, "holds a NoneType"),
    "claims_more_than_it_holds": ({"splats": views_that_claim(10**9)}, "more than the file holds"),
}


@pytest.mark.parametrize("name", BAD_DOCUMENTS)
def test_checkpoints_of_something_else(dataset, name, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    document, message = BAD_DOCUMENTS[name]
    torch.save(document, dataset.checkpoint)
    refused(dataset, message)
    assert not (tmp_path / "pwned").exists()


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("quats", None, "lack quats"),
        ("means", torch.full((20, 3), 1e300, dtype=torch.float64), "finite"),
        ("scales", torch.full((20, 3), -60.0), r"'scales'\] must "),
        ("sh0", [1.0], "sh0 must be a floating tensor, got list"),
        ("means", torch.zeros(20, 3).to_sparse(), "plain dense tensor"),
        ("means", torch.zeros(20, 3, device="meta"), "plain dense tensor"),
    ],
)
def test_splats_that_do_not_fit(dataset, name, value, message):
    splats = {**dataset.splats, name: value}
    if value is None:
        del splats[name]
    torch.save({"splats": splats}, dataset.checkpoint)
    refused(dataset, message)


def test_a_checkpoint_without_gaussians(dataset):
    torch.save({"splats": {name: tensor[:0] for name, tensor in dataset.splats.items()}}, dataset.checkpoint)
    refused(dataset, "at least one Gaussian")


def refused(dataset, message):
    with pytest.raises(CheckpointInvalid, match=rf"ckpt_29999\.pt: .*{message}") as caught:
        dataset.import_it()
    assert "\n" not in caught.value.detail
    assert len(caught.value.detail) < 500


def test_files_that_are_no_checkpoints(dataset, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    whole = dataset.checkpoint.read_bytes()
    for content in (b"", b"text", whole[:100], whole[: len(whole) // 2], whole[:-30], whole[200:]):
        dataset.checkpoint.write_bytes(content)
        refused(dataset, "truncated, or not a PyTorch checkpoint")
    dataset.checkpoint.write_bytes(pickle.dumps({"splats": Hostile()}))
    refused(dataset, ".")
    assert not (tmp_path / "pwned").exists()
    with zipfile.ZipFile(dataset.checkpoint, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", b"\0" * 10_000_000)
    refused(dataset, "compressed")
    dataset.checkpoint.unlink()
    refused(dataset, "no such file")
