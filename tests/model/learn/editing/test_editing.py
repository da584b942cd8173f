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
from ultragray.learn.labelling import PaintedFrame, label_by_frames, label_by_map, not_recorded
from ultragray.learn.motion import add_motion
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
from ultragray.scene.modes import Mode, Motion, Moving
from ultragray.scene.motion_settings import MotionSettings
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
PAINTED = PaintedFrame(np.eye(4), np.ones((SIDE, SIDE), np.uint8))
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


BALL = SphereShape(centre_mm=(0.0, 0.0, 20.0), radius_mm=9.0)
AROUND = BoxShape(min_mm=(-15.0, -15.0, 5.0), max_mm=(15.0, 15.0, 35.0))
BESIDE = SphereShape(centre_mm=(15.0, 0.0, 20.0), radius_mm=4.0)
EVERYWHERE = np.ones((45, 45, 45), np.uint8), np.array([[1, 0, 0, -22], [0, 1, 0, -22], [0, 0, 1, -2], [0, 0, 0, 1.0]])


@pytest.fixture(scope="module")
def with_tumour(scene):
    return edit_scene(scene, [InsertEdit(shape=BALL)])


def supported_share(scene):
    settings = FrameSettings(height=SIDE, width=SIDE).resolved(scene.info, Encoding.FLOAT32)
    assessor = Assessor(scene.info, scene.training_poses)
    watch = SupportWatch(assessor, assessor.assess(np.eye(4)), settings)
    render_shown(scene, settings, np.eye(4)[None], support=watch)
    return watch.completed(0, 1)[0].supported_share


def test_what_was_put_in_supports_no_confidence(scene, with_tumour):
    assert with_tumour.info.made_labels == (1,)
    lost = supported_share(scene) - supported_share(with_tumour)
    assert lost == pytest.approx(np.pi * 9.0**2 / 40.0**2, abs=0.03)


@pytest.mark.parametrize(
    ("relabel", "names", "made"),
    [
        ([RelabelEdit(shapes=(AROUND,), label="organ")], {"tumour", "organ", "organ (not recorded)"}, 2),
        ([RelabelEdit(shapes=(AROUND,))], {"tumour", "not recorded"}, 2),
        ([RelabelEdit(shapes=(BESIDE,), label="tumour")], {"tumour", "tumour (not recorded)"}, 1),
        ([RelabelEdit(shapes=(LabelShape(name="tumour"),), label="cyst")], {"tumour", "cyst"}, 2),
        (
            [RelabelEdit(shapes=(AROUND,), label="organ"), RelabelEdit(shapes=(AROUND,), label="other")],
            {"tumour", "organ", "organ (not recorded)", "other", "other (not recorded)"},
            3,
        ),
        (lambda scene: label_by_map(scene, *EVERYWHERE, names={1: "organ"}), {"organ", "organ (not recorded)"}, 1),
        (lambda scene: label_by_map(scene, 0 * EVERYWHERE[0], EVERYWHERE[1], names={}), {"tumour", "not recorded"}, 2),
        (
            lambda scene: label_by_frames(scene, [PAINTED, PAINTED], names={1: "bone"}, within_mm=3.0),
            {"bone", "bone (not recorded)"},
            1,
        ),
    ],
    ids=["painted over", "unlabelled", "painted elsewhere", "renamed", "twice", "map", "empty map", "frames"],
)
def test_what_was_put_in_counts_as_not_recorded_whatever_its_label(with_tumour, relabel, names, made):
    labelled = relabel(with_tumour) if callable(relabel) else edit_scene(with_tumour, relabel)
    assert set(labelled.info.label_names.values()) == names
    assert len(labelled.info.made_labels) == made
    np.testing.assert_array_equal(not_recorded(labelled), not_recorded(with_tumour))
    assert supported_share(labelled) == supported_share(with_tumour)


def test_a_part_that_was_moved_counts_as_not_recorded(scene, with_tumour):
    shift = {"shift_mm": (0.0, 0.0, 3.0)}
    moved = edit_scene(scene, [MoveEdit(shape=BALL, **shift)])
    assert (moved.info.label_names, moved.info.made_labels) == ({1: "not recorded"}, (1,))
    assert not_recorded(moved).sum() == (BALL.distance_mm(means_mm(scene)) < 0.0).sum()
    assert supported_share(moved) == supported_share(edit_scene(scene, [CutEdit(shape=BALL, keep="outside")]))
    further = edit_scene(with_tumour, [MoveEdit(shape=AROUND, **shift)])
    assert set(further.info.label_names.values()) == {"tumour", "not recorded"}
    whole = edit_scene(with_tumour, [MoveEdit(**shift)])
    np.testing.assert_array_equal(not_recorded(whole), not_recorded(with_tumour))


def test_of_two_scenes_one_may_have_recorded_what_the_other_made(scene, with_tumour):
    recorded = edit_scene(scene, [RelabelEdit(shapes=(BESIDE,), label="tumour")])
    for one, other in ((with_tumour, recorded), (recorded, with_tumour)):
        merge = MergeEdit(scene="other", fit_steps=0, match_gain=False)
        merged = edit_scene(one, [merge], others={"other": other})
        names = merged.info.label_names
        assert [names[label] for label in merged.info.made_labels] == ["tumour (not recorded)"]
        places = means_mm(merged)
        assert (BALL.distance_mm(places[not_recorded(merged)]) < 0.5).all()
        has_name = merged.labels.numpy() == next(label for label, name in names.items() if name == "tumour")
        assert (BESIDE.distance_mm(places[has_name]) < 0.0).all()
        assert has_name.any()


def test_a_body_that_fills_the_whole_scene_keeps_what_its_frames_need(scene):
    small = edit_scene(scene, [CutEdit(shape=SphereShape(centre_mm=MIDDLE, radius_mm=1.0))])
    filled = edit_scene(small, [InsertEdit(shape=SphereShape(centre_mm=MIDDLE, radius_mm=6.0))])
    np.testing.assert_array_equal(filled.training_poses, scene.training_poses)
    assert not_recorded(filled).all()


@pytest.fixture(scope="module")
def breathing(scene):
    return add_motion(scene, MotionSettings(chest_mm=6.0)).scene


@pytest.mark.parametrize(
    "edit",
    [
        InsertEdit(shape=SphereShape(centre_mm=(0.0, 0.0, 30.0), radius_mm=5.0)),
        LesionsEdit(count=1, radius_min_mm=2.0, radius_max_mm=3.0),
        CutEdit(shape=AROUND),
        RelabelEdit(shapes=(BALL,), label="organ"),
        ThinEdit(gaussian_count=8000),
        MoveEdit(shape=BALL, shift_mm=(0.0, 0.0, 5.0)),
    ],
    ids=lambda edit: edit.kind,
)
def test_what_an_edit_leaves_and_makes_moves_as_the_tissue_there_did(breathing, edit):
    edited = edit_scene(breathing, [edit])
    assert edited.moving is breathing.moving
    assert edited.info.motion == breathing.info.motion
    assert "left_out" not in edited.info.provenance["edits"][0]


def test_a_body_goes_with_the_breath(breathing):
    edited = edit_scene(breathing, [InsertEdit(shape=SphereShape(centre_mm=(0.0, 0.0, 30.0), radius_mm=5.0))])
    depths = []
    for phase in (0.0, 1.0):
        labels = frames(edited.at_phase([phase]), np.eye(4), ("labels",))[0].numpy()
        depths.append((np.nonzero(labels)[0].mean() + 0.5) / SIDE * 40.0)
    assert depths == pytest.approx([30.0, 36.0], abs=0.5)


@pytest.mark.parametrize("turn_deg", [(0.0, 0.0, 0.0), (20.0, -35.0, 10.0)], ids=["shifted", "turned"])
def test_the_motion_of_a_scene_is_moved_with_it(breathing, turn_deg):
    edit = MoveEdit(shift_mm=(4.0, -3.0, 2.0), turn_deg=turn_deg, about_mm=(1.0, 2.0, 3.0))
    moved = edit_scene(breathing, [edit]).at_phase([0.8])
    found, poses = frames(moved, moved.training_poses), breathing.training_poses
    assert psnr_db(found, frames(breathing.at_phase([0.8]), poses)) > 45.0
    assert psnr_db(found, frames(breathing, poses)) < 35.0


def test_a_merge_tells_that_it_leaves_motion_out(scene, breathing):
    merge = MergeEdit(scene="other", fit_steps=0, match_gain=False)
    for one, other in ((scene, breathing), (breathing, scene)):
        merged = edit_scene(one, [RelabelEdit(shapes=(BALL,), label="organ"), merge], others={"other": other})
        assert merged.moving is None
        assert merged.info.motion is None
        assert [told.get("left_out") for told in merged.info.provenance["edits"]] == [None, ["modes of motion"]]
    still = edit_scene(scene, [merge], others={"other": scene})
    assert "left_out" not in still.info.provenance["edits"][0]


def test_parts_of_a_moving_scene_move_when_they_are_merged_again(breathing):
    merge = MergeEdit(scene="other", fit_steps=0, match_gain=False)
    inside, outside = (edit_scene(breathing, [CutEdit(shape=AROUND, keep=side)]) for side in ("inside", "outside"))
    merged = edit_scene(inside, [merge], others={"other": outside})
    assert merged.moving.is_same(breathing.moving)
    assert merged.info.motion == breathing.info.motion
    assert "left_out" not in merged.info.provenance["edits"][0]
    assert psnr_db(*(frames(one.at_phase([0.8]), np.eye(4)) for one in (merged, breathing))) > 40.0
    elsewhere = edit_scene(outside, [MoveEdit(shift_mm=(4.0, 0.0, 0.0))])
    assert edit_scene(inside, [merge], others={"other": elsewhere}).moving is None


def test_motion_that_no_grid_holds_any_more_is_left_out_of_a_turned_scene(breathing):
    pulse = Motion((Mode("pulse", 0.0, 1.0),), origin_mm=(-22.0, -22.0, -2.0), spacing_mm=(0.85, 0.85, 0.85))
    moving = Moving(pulse, np.zeros((1, 53, 53, 53, 3), np.float32))
    fine = replace(breathing, moving=moving, info=replace(breathing.info, motion=pulse))
    turned = edit_scene(fine, [MoveEdit(turn_deg=(0.0, 45.0, 0.0))])
    assert turned.moving is None
    assert turned.info.provenance["edits"][0]["left_out"] == ["modes of motion"]


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
    for edit in (
        CutEdit(shape=far),
        MoveEdit(shape=far),
        RelabelEdit(shapes=(far,)),
        MergeEdit(scene="unknown"),
        InsertEdit(shape=far),
    ):
        with pytest.raises(InvalidArgument) as told:
            edit_scene(scene, [edit])
        assert told.value.field.startswith("edits")
    assert {Shape.members[kind].has_surface for kind in ("map", "label")} == {MapShape.has_surface}
