"""Edits of scenes: what they keep, what they make, and what the file of the result tells of them."""

from __future__ import annotations

import base64
import json
from dataclasses import replace

import nibabel
import numpy as np
import pytest
import torch
import trimesh

from ultragray import ConvexProbe, GaussianScene, LinearProbe, PhasedProbe, RadialProbe, SceneInfo, render
from ultragray.errors import InvalidArgument
from ultragray.learn.editing.editor import digest, edit_scene
from ultragray.learn.editing.insertion import insert
from ultragray.learn.editing.parts import means_mm, part
from ultragray.phantom.demo import DEMO_PROBE, load_demo_scene
from ultragray.rendering.confidence import SupportWatch
from ultragray.rendering.frames import render_shown
from ultragray.rendering.settings import Encoding, FrameSettings
from ultragray.scene.confidence import Assessor
from ultragray.scene.edits import (
    CutEdit,
    InsertEdit,
    LesionsEdit,
    MergeEdit,
    MoveEdit,
    RelabelEdit,
    ThinEdit,
    edits_of,
    read_edits,
)
from ultragray.scene.shapes import (
    BoxShape,
    EllipsoidShape,
    LabelShape,
    MapShape,
    MeshShape,
    Shape,
    SphereShape,
    TubeShape,
)
from ultragray.scene.tissues import TISSUES

SIDE = 96
PROBE = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=40.0)
MIDDLE = (1.0, 0.5, 20.0)


@pytest.fixture(scope="module")
def scene():
    """A block of 40 mm of even tissue with some grain, seen from poses along y."""
    random = np.random.default_rng(1)
    count = 12_000
    means = random.uniform(-2.1, 2.1, (count, 3)) + np.array([0.0, 0.0, 2.0])
    scales = np.log(random.uniform(0.05, 0.16, (count, 3)))
    splats = {
        "means": means,
        "scales": scales,
        "quats": random.normal(size=(count, 4)),
        "transmittances": np.full(count, 7.0),
        "sh0": random.normal(-0.2, 0.15, (count, 1, 1)),
        "shN": random.normal(0.0, 0.02, (count, 3, 1)),
    }
    info = SceneInfo(probe=PROBE, image_height=SIDE, image_width=SIDE, intensity="sigmoid")
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, 1, 3] = np.linspace(-12.0, 12.0, 9)
    tensors = {name: torch.from_numpy(values.astype(np.float32)) for name, values in splats.items()}
    return GaussianScene.from_splats(tensors, info=info, training_poses=poses)


def frames(scene, poses, outputs=("bmode",), probe=None):
    found = render(scene, probe, poses, height=SIDE, width=SIDE, outputs=outputs)
    return found[outputs[0]] if len(outputs) == 1 else found


def psnr_db(one, other):
    return float(-10.0 * torch.log10((one - other).square().mean()))


def test_a_moved_scene_looks_the_same_from_moved_poses(scene):
    edit = MoveEdit(shift_mm=(4.0, -3.0, 2.0), turn_deg=(20.0, -35.0, 10.0), about_mm=(1.0, 2.0, 3.0))
    moved = edit_scene(scene, [edit])
    assert psnr_db(frames(moved, moved.training_poses), frames(scene, scene.training_poses)) > 60.0
    np.testing.assert_allclose(moved.training_poses, edit.motion @ scene.training_poses)


def test_a_part_is_moved_without_the_poses(scene):
    shape = SphereShape(centre_mm=MIDDLE, radius_mm=6.0)
    moved = edit_scene(scene, [MoveEdit(shift_mm=(0.0, 0.0, 5.0), shape=shape)])
    inside = shape.distance_mm(means_mm(scene)) < 0.0
    after = np.sort(means_mm(moved)[:, 2]) - np.sort(np.where(inside, 5.0, 0.0) + means_mm(scene)[:, 2])
    assert np.abs(after).max() < 1e-3
    np.testing.assert_array_equal(moved.training_poses, scene.training_poses)


def test_two_halves_that_were_cut_merge_into_the_same_frames(scene):
    scene = replace(scene, training_poses=scene.training_poses[:2])  # much lies farther from them than counts
    box = BoxShape(min_mm=(-50.0, -50.0, -10.0), max_mm=(0.7, 50.0, 60.0))
    left, right = (edit_scene(scene, [CutEdit(shape=box, keep=side)]) for side in ("inside", "outside"))
    assert left.gaussian_count + right.gaussian_count == scene.gaussian_count
    assert (means_mm(left)[:, 0] < 0.7).all()
    merged = edit_scene(left, [MergeEdit(scene="right", match_gain=False)], others={"right": right})
    poses = scene.training_poses
    assert psnr_db(frames(merged, poses), frames(scene, poses)) > 90.0
    assert len(merged.training_poses) == 2 * len(poses)


def test_tissue_beside_a_body_stays_as_bright_where_long_gaussians_are_halved():
    scene = load_demo_scene()
    edit = InsertEdit(
        shape=EllipsoidShape(centre_mm=(-12.0, 10.0, 25.0), radii_mm=(1.2, 1.6, 1.4)), tissue="calcification", seed=1
    )
    scene = part(scene, np.abs(means_mm(scene)[:, 1] - 10.0) < 12.0)
    pose = np.eye(4)
    pose[1, 3] = 10.0
    origins, directions = DEMO_PROBE.scan_lines(SIDE)
    points = origins + DEMO_PROBE.depths_mm(SIDE)[:, None, None] * directions + pose[:3, 3]
    away = edit.shape.distance_mm(points.reshape(-1, 3)).reshape(SIDE, SIDE)
    beside = torch.from_numpy((away > 0.5) & (away < 1.5))
    before, after = (frames(one, pose, ("echo",), DEMO_PROBE)[0][beside].mean() for one in (scene, insert(scene, edit)))
    assert abs(float(after - before)) < 0.02


@pytest.mark.parametrize(
    ("length_mm", "away_mm", "quat", "stays"),
    [
        (6.0, 4.0, (1.0, 0.0, 0.0, 0.0), True),
        (50.0, 4.0, (1.0, 0.0, 0.0, 0.0), True),
        (6.0, 0.5, (1.0, 0.0, 0.0, 0.0), False),
        (6.0, 4.0, (1.0, 0.0, 1.0, 0.0), False),
    ],
    ids=["beside it", "very long beside it", "at its surface", "pointing at it"],
)
def test_a_long_gaussian_is_divided_only_where_it_reaches_into_a_body(scene, length_mm, away_mm, quat, stays):
    one = part(scene, np.array([0]))
    splats = {
        **one.splats,
        "means": torch.tensor([[0.0, 0.0, 0.5 + away_mm / 10.0]]),
        "scales": torch.tensor([[length_mm, 0.3, 0.3]]).div(10.0).log(),
        "quats": torch.tensor([quat]),
    }
    needle = GaussianScene.from_splats(splats, info=one.info, training_poses=one.training_poses)
    edited = insert(needle, InsertEdit(shape=SphereShape(centre_mm=(0.0, 0.0, 0.0), radius_mm=5.0)))
    kept = (edited.means == needle.means).all(dim=1) & (edited.scales == needle.scales).all(dim=1)
    assert bool(kept.any()) is stays


def test_bone_beside_a_body_looks_as_before():
    scene = load_demo_scene()
    shape = EllipsoidShape(centre_mm=(14.238, -10.728, 31.006), radii_mm=(1.7, 1.7, 1.3))
    scene = part(scene, np.abs(means_mm(scene)[:, 1] + 10.728) < 12.0)
    pose = np.eye(4)
    pose[1, 3] = -10.728
    origins, directions = DEMO_PROBE.scan_lines(SIDE)
    points = origins + DEMO_PROBE.depths_mm(SIDE)[:, None, None] * directions + pose[:3, 3]
    away = shape.distance_mm(points.reshape(-1, 3)).reshape(SIDE, SIDE)
    edited = insert(scene, InsertEdit(shape=shape, tissue="calcification"))
    before, after = (frames(one, pose, ("echo",), DEMO_PROBE)[0].numpy() for one in (scene, edited))
    assert np.abs(after - before)[(away > 2.0) & (away < 6.0)].max() < 0.1


def test_a_merged_scene_finds_its_place_and_its_gain(scene):
    motion = MoveEdit(shift_mm=(0.8, 0.3, -0.5), turn_deg=(0.0, 1.0, 0.0))
    darker = replace(scene, sh0=scene.sh0 - 0.1)
    other = edit_scene(darker, [motion])
    edit = MergeEdit(scene="other", register=True, fit_steps=0)
    merged = edit_scene(scene, [edit], others={"other": other})
    found = np.array(merged.info.provenance["edits"][0]["motion"])
    assert np.abs(found @ motion.motion - np.eye(4)).max() < 0.15
    poses = scene.training_poses[2:7]
    there, here = frames(merged, poses, ("echo",)).mean(), frames(scene, poses, ("echo",)).mean()
    dark = frames(darker, poses, ("echo",)).mean()
    assert abs(there - here) < 0.6 * abs(dark - here)


PROBES = {
    "linear": (PROBE, 0.0),
    "convex": (ConvexProbe(opening_angle_deg=60.0, near_mm=10.0, far_mm=45.0), -10.0),
    "phased": (PhasedProbe(opening_angle_deg=80.0, far_mm=40.0), 0.0),
    "radial": (RadialProbe(near_mm=2.0, far_mm=35.0), 8.0),
}


@pytest.mark.parametrize("kind", PROBES)
@pytest.mark.parametrize(
    "shape",
    [
        SphereShape(centre_mm=MIDDLE, radius_mm=5.0),
        EllipsoidShape(centre_mm=MIDDLE, radii_mm=(6.0, 4.0, 3.0), turn_deg=(10.0, 40.0, 20.0)),
    ],
    ids=["sphere", "ellipsoid"],
)
def test_an_inserted_body_is_where_its_shape_says_within_a_pixel(scene, kind, shape):
    probe, start_mm = PROBES[kind]
    edited = edit_scene(scene, [InsertEdit(shape=shape, tissue="cyst")])
    pose = np.eye(4)
    pose[2, 3] = start_mm
    labels = frames(edited, pose, ("labels",), probe)[0].numpy() == 1
    origins, directions = probe.scan_lines(SIDE)
    points = origins + probe.depths_mm(SIDE)[:, None, None] * directions + pose[:3, 3]
    away = shape.distance_mm(points.reshape(-1, 3)).reshape(SIDE, SIDE)
    lateral_mm = np.linalg.norm(np.diff(points, axis=1), axis=2)
    pixel_mm = np.hypot(probe.scan_line_length_mm / SIDE, np.pad(lateral_mm, ((0, 0), (0, 1)), "edge"))
    assert labels.sum() > 50
    assert (np.abs(away)[labels != (away < 0.0)] < pixel_mm[labels != (away < 0.0)]).all()


@pytest.mark.parametrize("tissue", ["cyst", "tumour", "fat", "calcification"])
def test_an_inserted_body_is_as_bright_and_shadows_as_its_tissue_says(scene, tissue):
    radius_mm = 2.0 if tissue == "calcification" else 5.0
    shape = SphereShape(centre_mm=(0.0, 0.0, 15.0), radius_mm=radius_mm)
    edited = edit_scene(scene, [InsertEdit(shape=shape, tissue=tissue)])
    before = frames(scene, np.eye(4), ("echo", "transmittance"))
    after = frames(edited, np.eye(4), ("echo", "transmittance"))
    x = -20.0 + 40.0 * (np.arange(SIDE) + 0.5) / SIDE
    z = 40.0 * (np.arange(SIDE) + 0.5) / SIDE
    away = np.hypot(x[None], z[:, None] - 15.0) - radius_mm
    around = float(before["echo"][0].numpy()[(away > 0.0) & (away < 5.0)].mean())
    inside = float(after["echo"][0].numpy()[away < -0.8].mean())
    wanted = float(np.clip(around + TISSUES[tissue].echo_db / 60.0, 0.0, 1.0))
    assert abs(inside - wanted) < 0.06

    lines = np.abs(x) < 0.5 * radius_mm
    row = int((15.0 + radius_mm + 1.0) / 40.0 * SIDE)
    left = (after["transmittance"][0, row] / before["transmittance"][0, row]).numpy()[lines]
    lost_db = 10.0 * max(0.0, TISSUES[tissue].attenuation - 0.54) * 0.2 * np.sqrt(radius_mm**2 - x[lines] ** 2)
    np.testing.assert_allclose(left, np.exp(-lost_db / (60.0 * around)), rtol=0.12)


def test_a_vessel_has_a_wall_and_a_lumen_without_flow(scene):
    path = TubeShape(points_mm=((-8.0, 0.0, 18.0), (0.0, 0.0, 22.0), (8.0, 0.0, 20.0)), radius_mm=3.0)
    edited = edit_scene(scene, [InsertEdit(shape=path, tissue="blood", label="vessel", wall_mm=0.8)])
    assert edited.info.label_names == {1: "vessel wall", 2: "vessel"}
    found = frames(edited, np.eye(4), ("labels", "echo"))
    lumen, wall = (found["labels"][0] == label for label in (2, 1))
    assert found["echo"][0][lumen].mean() < 0.1 < 0.3 < found["echo"][0][wall].mean()


def test_texture_comes_from_a_place_of_the_scene(scene):
    shape = SphereShape(centre_mm=MIDDLE, radius_mm=5.0)
    edit = InsertEdit(shape=shape, tissue="tumour", echo_db=0.0, texture_from_mm=(1.0, 0.5, 9.0))
    pose = np.eye(4)
    pose[1, 3] = 0.5
    there = frames(scene, pose, ("echo",))[0].numpy()
    here = frames(edit_scene(scene, [edit]), pose, ("echo",))[0].numpy()
    rows, columns, shift = slice(42, 55), slice(45, 56), round(11.0 / 40.0 * SIDE)
    from_there = there[rows.start - shift : rows.stop - shift, columns]
    assert np.corrcoef(here[rows, columns].ravel(), from_there.ravel())[0, 1] > 0.7
    with pytest.raises(InvalidArgument, match="texture_from_mm"):
        edit_scene(scene, [replace(edit, texture_from_mm=(500.0, 0.0, 0.0))])


def test_what_was_put_in_supports_no_confidence(scene):
    shape = SphereShape(centre_mm=(0.0, 0.0, 20.0), radius_mm=9.0)
    edited = edit_scene(scene, [InsertEdit(shape=shape)])
    assert edited.info.made_labels == (1,)
    settings = FrameSettings(height=SIDE, width=SIDE).resolved(edited.info, Encoding.FLOAT32)
    shares = []
    for one in (scene, edited):
        assessor = Assessor(one.info, one.training_poses)
        watch = SupportWatch(assessor, assessor.assess(np.eye(4)), settings)
        render_shown(one, settings, np.eye(4)[None], support=watch)
        shares.append(watch.completed(0, 1)[0].supported_share)
    assert shares[0] - shares[1] == pytest.approx(np.pi * 9.0**2 / 40.0**2, abs=0.03)


def test_lesions_are_drawn_within_what_was_seen_and_again_for_the_same_seed(scene):
    edit = LesionsEdit(count=3, seed=5, radius_min_mm=1.5, radius_max_mm=3.0)
    first, again = edit_scene(scene, [edit]), edit_scene(scene, [edit])
    assert digest(first) == digest(again)
    assert digest(edit_scene(scene, [replace(edit, seed=6)])) != digest(first)
    drawn = edits_of(first.info.provenance["edits"])
    assert len(drawn) == 3
    for one in drawn:
        (place,) = edit_scene(scene, [one]).info.made_labels
        seen = [(frames(first, pose, ("labels",)) == place).any() for pose in scene.training_poses]
        assert any(seen)


def test_gaussians_are_relabelled_by_a_brush_and_cut_by_their_label(scene):
    brush = tuple(SphereShape(centre_mm=(x, 0.0, 20.0), radius_mm=3.0) for x in (-4.0, 0.0, 4.0))
    labelled = edit_scene(scene, [RelabelEdit(shapes=brush, label="lesion")])
    inside = np.min([one.distance_mm(means_mm(scene)) for one in brush], axis=0) < 0.0
    np.testing.assert_array_equal(labelled.labels.numpy(), inside.astype(np.uint8))
    assert psnr_db(frames(labelled, np.eye(4)), frames(scene, np.eye(4))) == np.inf
    cut = edit_scene(labelled, [CutEdit(shape=LabelShape(name="lesion"), keep="outside")])
    assert cut.gaussian_count == (~inside).sum()
    with pytest.raises(InvalidArgument, match="nothing") as told:
        edit_scene(labelled, [CutEdit(shape=LabelShape(name="nothing"))])
    assert told.value.field == "edits[0].shape.name"


def test_meshes_and_label_maps_are_shapes(scene, tmp_path):
    ball = trimesh.creation.icosphere(3, 5.0)
    ball.apply_translation(MIDDLE)
    ball.export(tmp_path / "ball.stl")
    volume = np.zeros((20, 20, 20), np.uint8)
    volume[5:15, 5:15, 5:15] = 3
    affine = np.diag([1.0, 1.0, 1.0, 1.0])
    affine[:3, 3] = [-10.0, -10.0, 10.0]
    nibabel.save(nibabel.Nifti1Image(volume, affine), tmp_path / "map.nii.gz")
    document = [
        {"kind": "cut", "shape": {"kind": "mesh", "file": "ball.stl"}},
        {"kind": "relabel", "shapes": [{"kind": "map", "file": "map.nii.gz", "label": 3}], "label": "cube"},
    ]
    (tmp_path / "edits.json").write_text(json.dumps(document))
    cut, relabel = read_edits(tmp_path / "edits.json")
    places = np.random.default_rng(0).uniform(-9.0, 9.0, (2000, 3)) + MIDDLE
    exact = np.linalg.norm(places - MIDDLE, axis=1) - 5.0
    assert np.abs(cut.shape.distance_mm(places) - exact).max() < 0.1
    cube = np.abs(means_mm(scene) - [-0.5, -0.5, 19.5]).max(axis=1) < 5.0
    labelled = edit_scene(scene, [relabel])
    np.testing.assert_array_equal(labelled.labels.numpy() > 0, cube)
    (told,) = labelled.info.provenance["edits"]
    assert told["shapes"][0]["data"].startswith("sha256:")
    with pytest.raises(InvalidArgument, match="body"):
        InsertEdit(shape=relabel.shapes[0])
    with pytest.raises(InvalidArgument, match="surface"):
        MeshShape(data=base64.b64encode(b"no mesh").decode()).distance_mm(places)


def test_thinning_keeps_what_shows(scene):
    poses = scene.training_poses
    thinned = edit_scene(scene, [ThinEdit(gaussian_count=8000)])
    assert thinned.gaussian_count == 8000
    random = np.sort(np.random.default_rng(0).permutation(scene.gaussian_count)[:8000])
    splats = {name: raw[random] for name, raw in scene.splats.items()}
    at_random = GaussianScene.from_splats(splats, info=scene.info, training_poses=poses)
    whole = frames(scene, poses)
    assert psnr_db(frames(thinned, poses), whole) > psnr_db(frames(at_random, poses), whole) + 5.0
    small = edit_scene(scene, [ThinEdit(file_bytes=200_000)])
    assert 190_000 < len(small.to_bytes()) <= 202_000


def test_a_scene_file_tells_its_parents_and_edits(scene, tmp_path):
    edit = RelabelEdit(shapes=(SphereShape(centre_mm=MIDDLE, radius_mm=4.0),), label="cyst")
    edited = edit_scene(scene, [edit], names={"liver": "ab" * 32})
    for suffix in (".ugr", ".ugz"):
        edited.save(tmp_path / f"edited{suffix}")
        told = GaussianScene.load(tmp_path / f"edited{suffix}").info.provenance
        assert told["parents"] == {"liver": "ab" * 32}
        assert edits_of(told["edits"]) == (edit,)
    assert edit_scene(scene, [edit]).info.provenance["parents"] == {"scene": digest(scene)}


@pytest.mark.parametrize(
    ("document", "field"),
    [
        ([], "edits"),
        ([{"kind": "melt"}], "edits[0].kind"),
        ([{"kind": "cut", "shape": {"kind": "sphere", "centre_mm": [0, 0, 0], "radius_mm": -1}}], "radius_mm"),
        ([{"kind": "insert", "shape": {"kind": "label", "name": "x"}}], "edits[0].shape"),
        ([{"kind": "thin"}], "gaussian_count"),
        ([{"kind": "merge", "scene": "x", "seam": 1}], "seam"),
        ([{"kind": "lesions", "tissues": ["stone"]}], "tissues"),
    ],
)
def test_wrong_edits_are_refused_by_the_path_of_what_is_wrong(document, field):
    with pytest.raises(InvalidArgument) as told:
        edits_of(document)
    assert (told.value.field or "").endswith(field)


def test_edits_that_fit_no_scene_are_refused(scene):
    far = SphereShape(centre_mm=(500.0, 0.0, 0.0), radius_mm=5.0)
    for edit in (CutEdit(shape=far), MoveEdit(shape=far), RelabelEdit(shapes=(far,)), MergeEdit(scene="unknown")):
        with pytest.raises(InvalidArgument) as told:
            edit_scene(scene, [edit])
        assert told.value.field.startswith("edits")
    assert {Shape.members[kind].has_surface for kind in ("map", "label")} == {MapShape.has_surface}
