"""Modes of motion from fields that are given: of files, of a chest, of a vessel."""

import math

import h5py
import nibabel
import numpy as np
import pytest
import SimpleITK
import torch

from ultragray import GaussianScene, LinearProbe
from ultragray.errors import InvalidArgument
from ultragray.learn.motion import add_motion
from ultragray.learn.motion_fields import field_of_voxels, pulsation, vessel_of, with_mode
from ultragray.scene.info import SceneInfo
from ultragray.scene.label_maps import VectorField, read_label_map, read_vector_field
from ultragray.scene.modes import Mode
from ultragray.scene.motion_settings import MotionSettings
from ultragray.scene.shapes import LabelShape, SphereShape, TubeShape

PROBE = LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=40.0)
SHIFT = torch.tensor([1.5, -0.7, 2.0], dtype=torch.float64)
TURN = torch.tensor([[0.0, 0.04, 0.0], [-0.04, 0.05, 0.0], [0.02, 0.0, 0.06]], dtype=torch.float64)


def truth(points):  # [N, 3] mm of the tissue at rest -> [N, 3]
    return points @ TURN.T + SHIFT


@pytest.fixture
def scene(random_scene):
    still = random_scene(400, seed=4, extent_cm=(3.0, 2.0, 4.0), centre_cm=(0.0, 0.0, 2.0), sigma_cm=(0.08, 0.2))
    return GaussianScene.from_splats(still.splats, info=SceneInfo(probe=PROBE))


@pytest.fixture
def points(scene):
    low, high = (torch.tensor(one, dtype=torch.float64) for one in (scene.info.bounds_min_mm, scene.info.bounds_max_mm))
    return low + (high - low) * torch.rand((50, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def displacement(scene, phase, points):
    return scene.at_phase(phase).displacements[0].at(points)[0]


AFFINE = np.array([[0.0, 3.0, 0.0, -40.0], [-2.5, 0.0, 0.0, 40.0], [0.0, 0.0, 4.0, -30.0], [0.0, 0.0, 0.0, 1.0]])
SHAPE = (32, 30, 26)


def voxels_mm():  # [I, J, K, 3]
    return np.stack(np.meshgrid(*map(np.arange, SHAPE), indexing="ij"), axis=-1) @ AFFINE[:3, :3].T + AFFINE[:3, 3]


def test_a_field_of_vectors_becomes_a_mode_whichever_way_it_leads(scene, points):
    at = torch.from_numpy(voxels_mm()).reshape(-1, 3)
    there = truth(at)
    back = torch.linalg.solve(torch.eye(3, dtype=torch.float64) + TURN, (at - SHIFT).T).T - at
    for leads, vectors in (("from-rest", there), ("to-rest", back)):
        field = field_of_voxels(VectorField(vectors.reshape(*SHAPE, 3).numpy(), AFFINE), scene.info, leads)
        moving, residual = with_mode(scene, Mode("breathing", 0.0, 1.0), field, 8.0)
        assert residual.most_mm < 0.02
        torch.testing.assert_close(displacement(moving, (1.0,), points), truth(points), atol=0.02, rtol=0)
        torch.testing.assert_close(displacement(moving, (0.5,), points), truth(points) / 2.0, atol=0.02, rtol=0)


def test_a_registration_leads_a_field_and_its_vectors_into_the_scene(scene, points):
    vectors = np.broadcast_to([1.0, 0.0, 0.0], (*SHAPE, 3)).copy()
    turn = np.eye(4)
    turn[:3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    field = field_of_voxels(VectorField(vectors, AFFINE), scene.info, "from-rest", turn)
    torch.testing.assert_close(field(points), torch.tensor([[0.0, 1.0, 0.0]], dtype=torch.float64).expand(50, 3))
    turn[:3, 3] = 500.0
    with pytest.raises(InvalidArgument, match="lies beyond the scene"):
        field_of_voxels(VectorField(vectors, AFFINE), scene.info, "from-rest", turn)


def test_a_field_that_folds_is_not_inverted(scene):
    vectors = 12.0 * np.sin(voxels_mm() / 3.0)
    field = field_of_voxels(VectorField(vectors, AFFINE), scene.info, "to-rest")
    with pytest.raises(InvalidArgument, match="folds"):
        with_mode(scene, Mode("breathing", 0.0, 1.0), field, 8.0)
    with pytest.raises(InvalidArgument, match="must be from-rest or to-rest, got 'both'"):
        field_of_voxels(VectorField(vectors, AFFINE), scene.info, "both")


LPS = np.array([-1.0, -1.0, 1.0])  # of RAS, and back


def image_of(vectors):  # [I, J, K, 3] RAS, at AFFINE
    image = SimpleITK.GetImageFromArray((vectors * LPS).transpose(2, 1, 0, 3), isVector=True)
    spacing = np.linalg.norm(AFFINE[:3, :3], axis=0)
    image.SetSpacing(spacing.tolist())
    image.SetDirection((LPS[:, None] * AFFINE[:3, :3] / spacing).ravel().tolist())
    image.SetOrigin((LPS * AFFINE[:3, 3]).tolist())
    return image


@pytest.mark.parametrize("name", ["field.nrrd", "field.nii.gz"])
def test_the_displacements_that_itk_writes_are_read(tmp_path, name):
    vectors = np.random.default_rng(0).normal(size=(*SHAPE, 3))  # RAS
    SimpleITK.WriteImage(image_of(vectors), tmp_path / name)
    found = read_vector_field(tmp_path / name, None if name.endswith("nrrd") else "lps")
    np.testing.assert_allclose(found.vectors, vectors, atol=1e-6)
    np.testing.assert_allclose(found.affine, AFFINE, atol=1e-5)
    if name.endswith("nrrd"):
        with pytest.raises(InvalidArgument, match="says that its vectors are left-posterior-superior, not ras"):
            read_vector_field(tmp_path / name, "ras")
        measured = (
            (tmp_path / name).read_bytes().replace(b"kinds:", b"measurement frame: (0,1,0) (-1,0,0) (0,0,1)\nkinds:")
        )
        (tmp_path / name).write_bytes(measured)
        turned = (vectors * LPS) @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) * LPS
        np.testing.assert_allclose(read_vector_field(tmp_path / name).vectors, turned, atol=1e-6)
    else:
        with pytest.raises(
            InvalidArgument, match="does not say in which axes its vectors are: ras or lps must be given"
        ):
            read_vector_field(tmp_path / name)


@pytest.mark.parametrize("name", ["field.h5", "field.tfm"])
def test_a_grid_transform_is_the_field_that_itk_wrote(tmp_path, name):
    vectors = np.random.default_rng(0).normal(size=(4, 5, 6, 3))
    transform = SimpleITK.DisplacementFieldTransform(image_of(vectors))
    SimpleITK.WriteTransform(transform, tmp_path / name)
    found = read_vector_field(tmp_path / name)
    image = nibabel.Nifti1Image(vectors, AFFINE)
    image.header.set_intent(1006)
    nibabel.save(image, tmp_path / "field.nii")
    same = read_vector_field(tmp_path / "field.nii")
    np.testing.assert_allclose(found.vectors, same.vectors, atol=1e-9)
    np.testing.assert_allclose(found.affine, same.affine, atol=1e-5)
    at = (AFFINE @ [1.3, 2.6, 3.2, 1.0])[:3]
    moved = np.array(transform.TransformPoint((at * LPS).tolist())) * LPS
    field = field_of_voxels(found, SceneInfo(bounds_min_mm=tuple(at - 1.0), bounds_max_mm=tuple(at + 1.0)), "from-rest")
    np.testing.assert_allclose(at + field(torch.from_numpy(at)[None])[0].numpy(), moved, atol=1e-6)
    with pytest.raises(InvalidArgument, match="says that its vectors are lps, not ras"):
        read_vector_field(tmp_path / name, "ras")


def test_a_grid_transform_of_old_itk_and_of_slicer_is_read(tmp_path):
    vectors = np.random.default_rng(0).normal(size=(4, 5, 6, 3))
    path = tmp_path / "field.h5"
    SimpleITK.WriteTransform(SimpleITK.DisplacementFieldTransform(image_of(vectors)), path)
    with h5py.File(path, "r+") as file:
        group = file["TransformGroup/0"]
        for name in ("Parameters", "FixedParameters"):
            group.move(f"Transform{name}", f"Tranform{name}")
        del group["TransformType"]
        group["TransformType"] = ["InverseDisplacementFieldTransform_double_3_3"]
    np.testing.assert_allclose(read_vector_field(path).vectors, vectors, atol=1e-9)


@pytest.mark.parametrize("suffix", [".h5", ".tfm"])
def test_other_transforms_are_refused_by_their_names(tmp_path, suffix):
    path = tmp_path / f"other{suffix}"
    grid = SimpleITK.DisplacementFieldTransform(image_of(np.zeros((4, 5, 6, 3))))
    splines = SimpleITK.BSplineTransform(3)
    for transform, name in (
        (splines, "it is BSplineTransform_double_3_3: Slicer's module Transforms converts others"),
        (SimpleITK.CompositeTransform([SimpleITK.AffineTransform(3), grid]), "AffineTransform_double_3_3, Disp"),
    ):
        SimpleITK.WriteTransform(transform, path)
        with pytest.raises(InvalidArgument, match=name):
            read_vector_field(path)
    path.write_bytes(b"#Insight Transform File V1.0\n")
    with pytest.raises(InvalidArgument, match=r"cannot be read as HDF5|it is none"):
        read_vector_field(path)
    with pytest.raises(InvalidArgument, match=r"must end in \.nii, \.nii\.gz or \.nrrd, got"):
        read_label_map(path)


def test_a_grid_transform_without_all_its_numbers_is_refused(tmp_path):
    path = tmp_path / "field.tfm"
    SimpleITK.WriteTransform(SimpleITK.DisplacementFieldTransform(image_of(np.zeros((4, 5, 6, 3)))), path)
    path.write_text(path.read_text().replace("FixedParameters: 4 ", "FixedParameters: 5 "))
    with pytest.raises(InvalidArgument, match="cannot be read as a transform: it holds 360 of 450 numbers"):
        read_vector_field(path)


def test_a_transform_whose_parameters_lie_in_another_file_is_refused(tmp_path):
    for name in ("linked.h5", "other.h5"):
        SimpleITK.WriteTransform(
            SimpleITK.DisplacementFieldTransform(image_of(np.zeros((4, 5, 6, 3)))), tmp_path / name
        )
    with h5py.File(tmp_path / "linked.h5", "r+") as file:
        del file["TransformGroup/0/TransformParameters"]
        other = h5py.ExternalLink("other.h5", "TransformGroup/0/TransformParameters")
        file["TransformGroup/0/TransformParameters"] = other
    with pytest.raises(InvalidArgument, match="must lie in the file itself"):
        read_vector_field(tmp_path / "linked.h5")


def test_nifti_that_says_displacement_is_in_its_own_axes(tmp_path):
    vectors = np.random.default_rng(0).normal(size=(4, 5, 6, 3)).astype(np.float32)
    for shape in ((4, 5, 6, 3), (4, 5, 6, 1, 3)):
        image = nibabel.Nifti1Image(vectors.reshape(shape), AFFINE)
        image.header.set_intent(1006)
        nibabel.save(image, tmp_path / "field.nii")
        np.testing.assert_array_equal(read_vector_field(tmp_path / "field.nii").vectors, vectors)
    with pytest.raises(InvalidArgument, match="says that its vectors are ras, not lps"):
        read_vector_field(tmp_path / "field.nii", "lps")
    nibabel.save(nibabel.Nifti1Image(vectors[..., 0], AFFINE), tmp_path / "field.nii")
    with pytest.raises(InvalidArgument, match="three numbers a voxel"):
        read_vector_field(tmp_path / "field.nii", "ras")


def test_a_built_in_chest_moves_deep_tissue_and_leaves_the_skin(scene):
    moving = add_motion(scene, MotionSettings(chest_mm=8.0)).scene
    low, high = scene.info.bounds_min_mm[2], scene.info.bounds_max_mm[2]
    moved = displacement(moving, (1.0,), torch.tensor([[0.0, 0.0, low], [0.0, 0.0, high]]))
    assert moved[0, 2] < 0.5
    assert 7.5 < moved[1, 2] < 8.1
    assert moved[:, :2].abs().max() < 1e-6


TUBE = TubeShape(points_mm=((0.0, -12.0, 18.0), (0.0, 0.0, 20.0), (0.0, 12.0, 22.0)), radius_mm=4.0)


def test_what_a_vessel_pushes_out_passes_through_every_cylinder_about_it(scene):
    angle = torch.linspace(0.0, 2.0 * math.pi, 37, dtype=torch.float64)[:-1]
    straight = TubeShape(points_mm=((0.0, -12.0, 20.0), (0.0, 12.0, 20.0)), radius_mm=4.0)
    added = add_motion(scene, MotionSettings(pulse_mm=0.5, vessel=straight))
    assert added.scene.info.motion.modes[0].name == "pulse"
    assert added.residual.most_mm < 0.06
    for radius, wanted in ((2.0, 0.25), (4.0, 0.5), (8.0, 0.25), (12.0, 0.5 / 3.0)):
        out = torch.stack([angle.cos(), torch.zeros(36), angle.sin()], dim=1)
        moved = (displacement(added.scene, (1.0,), torch.tensor([0.0, 1.0, 20.0]) + radius * out) * out).sum(dim=1)
        assert abs(float(moved.mean()) - wanted) < (0.06 if radius == 4.0 else 0.02), radius
    with pytest.raises(InvalidArgument, match="belong together"):
        MotionSettings(pulse_mm=0.5)
    with pytest.raises(InvalidArgument, match="kind tube or label, got sphere"):
        MotionSettings(pulse_mm=0.5, vessel=SphereShape(centre_mm=(0.0, 0.0, 0.0), radius_mm=1.0))


def test_the_tube_of_a_labelled_vessel_is_found(scene):
    random = np.random.default_rng(0)
    way = np.array(TUBE.points_mm)
    along, out, angle = random.random(200) * 2.0, 4.0 * np.sqrt(random.random(200)), 2.0 * np.pi * random.random(200)
    middle = np.stack([np.interp(along, [0, 1, 2], way[:, axis]) for axis in range(3)], axis=1)
    means = middle + np.stack([out * np.cos(angle), np.zeros(200), out * np.sin(angle)], axis=1)
    splats = {name: tensor.clone() for name, tensor in scene.splats.items()}
    splats["means"][:200] = torch.from_numpy(means / 10.0).float()
    info = SceneInfo(probe=PROBE, label_names={1: "bone", 7: "artery"})
    labels = torch.cat([torch.full((200,), 7), torch.full((200,), 1)]).to(torch.uint8)
    labelled = GaussianScene.from_splats(splats, info=info, labels=labels)
    tube = vessel_of(labelled, LabelShape(name="artery"))
    assert abs(tube.radius_mm - 4.0) < 0.4
    assert (TUBE.distance_mm(np.array(tube.points_mm)[1:-1]) + TUBE.radius_mm).max() < 1.2
    added = add_motion(labelled, MotionSettings(pulse_mm=0.5, vessel=LabelShape(name="artery")))
    assert added.tube == tube
    with pytest.raises(InvalidArgument, match="'vein' has 0; labels: bone, artery"):
        vessel_of(labelled, LabelShape(name="vein"))


def test_a_mode_joins_those_that_a_scene_has_and_changes_none(scene, points):
    breathing = add_motion(scene, MotionSettings(chest_mm=8.0)).scene
    both = add_motion(breathing, MotionSettings(pulse_mm=0.5, vessel=TUBE)).scene
    assert [mode.name for mode in both.info.motion.modes] == ["breathing", "pulse"]
    assert both.info.motion.spacing_mm < breathing.info.motion.spacing_mm
    alone = displacement(breathing, (1.0,), points)
    torch.testing.assert_close(displacement(both, (1.0, 0.0), points), alone, atol=0.01, rtol=0)
    pulse = displacement(both, (0.0, 1.0), points)
    torch.testing.assert_close(pulse, pulsation(TUBE, 0.5)(points), atol=0.08, rtol=0)
    torch.testing.assert_close(displacement(both, (1.0, 1.0), points), alone + pulse, atol=0.01, rtol=0)
    with pytest.raises(InvalidArgument, match="a mode that is called breathing already"):
        add_motion(both, MotionSettings(chest_mm=3.0))
    third = add_motion(both, MotionSettings(chest_mm=3.0, name="belly")).scene
    np.testing.assert_allclose(third.moving.coefficients[:2], both.moving.coefficients, atol=1e-5)
    with pytest.raises(InvalidArgument, match="spacing_mm must be greater"):
        add_motion(both, MotionSettings(chest_mm=3.0, name="belly", spacing_mm=0.3))


def test_a_mode_comes_from_one_place(scene):
    with pytest.raises(InvalidArgument, match="exactly one of chest_mm, pulse_mm, sweep, field, got none"):
        add_motion(scene, MotionSettings())
    with pytest.raises(InvalidArgument, match="got chest_mm, field"):
        add_motion(scene, MotionSettings(chest_mm=1.0), field=truth)
