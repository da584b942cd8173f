"""Volumes and slices of a scene against sums over all Gaussians in float64, read back by nibabel and SimpleITK."""

from dataclasses import replace

import nibabel
import numpy as np
import pytest
import SimpleITK
import torch

from ultragray import GaussianScene
from ultragray.errors import FrameTooCostly, InvalidArgument
from ultragray.geometry.pose import check_poses
from ultragray.rendering import volume_fields as fields_module
from ultragray.rendering.limits import GivenUp, Limits
from ultragray.rendering.settings import Encoding
from ultragray.rendering.volume_fields import sample_slice, sample_volume, write_slice, write_volume
from ultragray.rendering.volumes import MAX_VOXELS, VOLUME_FIELDS, SliceSettings, VolumeGrid, parse_box, parse_numbers

from .weights import gaussian_weights

CENTRE_MM = (12.0, -34.0, 56.0)
GRID = VolumeGrid.over_box((-4, -38, 70), (28, -29, 84.5), 1.5)  # 22 x 6 x 10
TILTED = VolumeGrid.on_plane((0, -36, 60), (3, 0, 1), (-0.5, 1, 1.5), (25, 20), 1.25)


@pytest.fixture
def scene(random_scene):
    made = random_scene(150, sh_degree=1)
    labels = torch.from_numpy(np.random.default_rng(1).choice([0, 1, 2, 9], 150).astype(np.uint8))
    info = replace(made.info, centre_mm=CENTRE_MM, label_names={1: "bone", 2: "muscle", 9: "a\nvessel"})
    return GaussianScene.from_splats(made.splats, info=info, labels=labels)


def expected_at(scene, field, points_mm):  # [P, 3] -> [P]
    """The sums as the module's docstring writes them."""
    weights = np.minimum(gaussian_weights(scene, (points_mm - np.array(CENTRE_MM)) / 10.0), 0.999)
    weights[weights < 1 / 255] = 0.0
    if field == "labels":
        by_label = np.stack([weights[scene.labels.numpy() == label].sum(axis=0) for label in range(256)])
        return np.where(by_label.max(axis=0) >= 1 / 255, by_label.argmax(axis=0), 0)
    sh0, logits = (scene.splats[name].double().numpy().ravel() for name in ("sh0", "transmittances"))
    brightness, sums = np.clip(0.5 / np.sqrt(np.pi) * sh0 + 1, 0.5, 0.999), weights.sum(axis=0)
    values = {
        "coverage": 1 - np.exp(-sums),
        "echo": (1 - np.exp(-sums)) * (brightness @ weights) / (sums + 1e-8),
        "attenuation": 1 / (1 + np.exp(logits)) @ weights / 10.0,
    }
    return values[field]


def points_of(grid):  # [K·J·I, 3]
    k, j, i = np.indices(grid.shape[::-1]).reshape(3, -1)
    return (np.stack([i, j, k, np.ones_like(i)], axis=1) @ grid.affine.T)[:, :3]


@pytest.mark.parametrize("field", VOLUME_FIELDS)
@pytest.mark.parametrize("grid", [GRID, TILTED], ids=["box", "tilted plane"])
def test_values_are_the_sums_over_all_gaussians(scene, field, grid):
    got = np.concatenate(list(sample_volume(scene, field, grid)))
    expected = expected_at(scene, field, points_of(grid)).reshape(grid.shape[::-1])
    assert (expected > 0).mean() > 0.05  # the grid meets the scene
    assert got.dtype == (np.uint8 if field == "labels" else np.float32)
    np.testing.assert_allclose(got, expected, atol=1e-6)


@pytest.mark.parametrize("field", VOLUME_FIELDS)
def test_small_portions_give_the_same(scene, field, monkeypatch):
    whole = np.concatenate(list(sample_volume(scene, field, GRID)))
    monkeypatch.setattr(fields_module, "VOXELS_AT_ONCE", 300)  # two layers at once
    slabs = list(sample_volume(scene, field, GRID))
    assert [len(slab) for slab in slabs] == [2] * 5
    np.testing.assert_allclose(np.concatenate(slabs), whole, atol=1e-6)


@pytest.mark.parametrize("suffix", [".nii.gz", ".nii"])
@pytest.mark.parametrize("field", ["echo", "labels"])
def test_nibabel_reads_the_volume_where_it_lies(scene, tmp_path, suffix, field):
    path = tmp_path / f"v{suffix}"
    write_volume(path, scene, field, GRID)
    image = nibabel.load(path)
    assert nibabel.aff2axcodes(image.affine) == ("R", "A", "S")
    assert image.header.get_xyzt_units()[0] == "mm"
    np.testing.assert_allclose(image.affine, GRID.affine, atol=1e-5)
    np.testing.assert_allclose(image.header.get_zooms(), (1.5, 1.5, 1.5))
    values = np.asarray(image.dataobj)
    assert values.shape == GRID.shape
    np.testing.assert_array_equal(values.T, np.concatenate(list(sample_volume(scene, field, GRID))))


@pytest.mark.parametrize("suffix", [".nii.gz", ".nrrd"])
@pytest.mark.parametrize("grid", [GRID, TILTED], ids=["box", "tilted plane"])
def test_simpleitk_finds_each_point_where_the_scene_has_it(scene, tmp_path, suffix, grid):
    path = tmp_path / f"v{suffix}"
    write_volume(path, scene, "echo", grid)
    image = SimpleITK.ReadImage(str(path))
    assert image.GetSize() == grid.shape
    np.testing.assert_allclose(image.GetSpacing(), grid.spacing_mm, rtol=1e-5)
    to_lps = np.diag([-1.0, -1.0, 1.0])  # ITK's frame
    np.testing.assert_allclose(image.GetOrigin(), to_lps @ grid.origin_mm, atol=1e-4)
    np.testing.assert_allclose(np.reshape(image.GetDirection(), (3, 3)), to_lps @ grid.axes.T, atol=1e-5)
    np.testing.assert_array_equal(
        SimpleITK.GetArrayFromImage(image), np.concatenate(list(sample_volume(scene, "echo", grid)))
    )
    brightest = np.unravel_index(SimpleITK.GetArrayFromImage(image).argmax(), grid.shape[::-1])
    point = to_lps @ image.TransformIndexToPhysicalPoint([int(v) for v in brightest[::-1]])
    (value,) = expected_at(scene, "echo", point[None])
    assert SimpleITK.GetArrayFromImage(image).max() == pytest.approx(value, abs=1e-3)


def test_nrrd_names_the_labels(scene, tmp_path):
    write_volume(tmp_path / "l.nrrd", scene, "labels", GRID)
    image = SimpleITK.ReadImage(str(tmp_path / "l.nrrd"))
    assert image.GetMetaData("label 2") == "muscle"
    assert b"label 9:=a\\nvessel\n" in (tmp_path / "l.nrrd").read_bytes()


def test_a_slice_is_a_picture_or_an_array(scene, tmp_path):
    import cv2

    expected = sample_slice(scene, "attenuation", TILTED)
    assert expected.shape == (16, 20)
    for name in ("s.npy", "s.png"):
        write_slice(tmp_path / name, scene, "attenuation", TILTED)
    np.testing.assert_array_equal(np.load(tmp_path / "s.npy"), expected)
    picture = cv2.imread(str(tmp_path / "s.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose(picture / 255.0, expected / expected.max(), atol=0.5 / 255 + 1e-6)


def test_mistakes_are_told(scene, tmp_path, random_scene):
    with pytest.raises(InvalidArgument, match=f"the limit is {MAX_VOXELS:,}.*take about 0.15"):
        VolumeGrid.over_box((0, 0, 0), (100, 100, 100), 0.1)
    VolumeGrid.over_box((0, 0, 0), (100, 100, 100), 0.16)  # what the message says does
    with pytest.raises(InvalidArgument, match="box_mm must extend along each axis"):
        VolumeGrid.over_box((0, 0, 0), (1, 0, 1), 0.1)
    with pytest.raises(InvalidArgument, match=r"spacing_mm must be 0\.001 to 1e\+06 mm, got nan"):
        VolumeGrid.over_box((0, 0, 0), (1, 1, 1), float("nan"))
    with pytest.raises(InvalidArgument, match=r"right angle to right, the angle is 45\.00°"):
        VolumeGrid.on_plane((0, 0, 0), (1, 0, 0), (1, 1, 0), (10, 10), 1.0)
    with pytest.raises(InvalidArgument, match="right must be a direction"):
        VolumeGrid.on_plane((0, 0, 0), (0, 0, 0), (1, 1, 0), (10, 10), 1.0)
    with pytest.raises(InvalidArgument, match="labels are for scenes whose Gaussians carry them"):
        sample_volume(random_scene(3), "labels", GRID)
    with pytest.raises(InvalidArgument, match="field must be one of echo, coverage, attenuation, labels, got 'bmode'"):
        sample_volume(scene, "bmode", GRID)
    with pytest.raises(InvalidArgument, match=r"must end in \.nii\.gz, \.nii, \.nrrd, got 'v\.vtk'"):
        write_volume(tmp_path / "v.vtk", scene, "echo", GRID)
    with pytest.raises(InvalidArgument, match="ranges of x, y and z"):
        parse_box("1:2,3:4")
    with pytest.raises(InvalidArgument, match="right must be 3 finite numbers"):
        parse_numbers("1,2", 3, "right")
    assert parse_box("-1:2,3:4,5:6.5") == ((-1, 3, 5), (2, 4, 6.5))


PLANE = SliceSettings(origin_mm=(3, -2, 10), right=(2, 1, 0), down=(0, 0, 4), size_mm=(12, 7.5), spacing_mm=0.5)


def test_the_pose_of_a_slice_leads_back_to_its_pixels():
    pose, grid = PLANE.pose(), PLANE.grid()
    np.testing.assert_allclose(check_poses(pose)[0], pose, atol=1e-12)  # rigid
    view = PLANE.view(Encoding.FLOAT32)
    again = view.grid(pose)
    assert again.shape == grid.shape == (24, 15, 1)
    np.testing.assert_allclose(again.affine, grid.affine, atol=1e-12)
    assert (view.picture.height, view.picture.width) == (view.height, view.width) == (15, 24)
    last = pose @ (view.picture.step[0] * 23, 0, view.picture.step[1] * 14, 1)
    np.testing.assert_allclose(last, grid.affine @ (23, 14, 0, 1), atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"field": "bmode"}, "field"),
        ({"right": (0, 0, 1)}, "down"),
        ({"size_mm": (0, 1)}, "size_mm"),
        ({"size_mm": (3.8e16, 3.1e299)}, "size_mm"),
        ({"size_mm": (1e6, 1e6)}, "spacing_mm"),
        ({"origin_mm": (0, -1e308, 0)}, "origin_mm"),
        ({"origin_mm": (0, 0, float("nan"))}, "origin_mm[2]"),
    ],
)
def test_planes_that_cannot_be_are_refused(changes, field):
    with pytest.raises(InvalidArgument) as caught:
        SliceSettings(**{"origin_mm": (0, 0, 0), "size_mm": (10, 10), **changes})
    assert caught.value.field == field


def test_a_slice_is_bound_by_its_cost_and_ends_where_it_is_given_up(random_scene):
    scene = random_scene(100)
    grid = SliceSettings(origin_mm=(-20, 0, 0), size_mm=(40, 40)).grid()
    assert sample_slice(scene, "echo", grid, Limits(10**9)).any()
    with pytest.raises(FrameTooCostly, match="footprint pixels"):
        sample_slice(scene, "echo", grid, Limits(1000))
    with pytest.raises(GivenUp):
        sample_slice(scene, "echo", grid, Limits(flag=np.array([7]), number=7))
