"""Tissue that follows the probe: poses as tracked lead to where the tissue at rest looks as the sweep's frames did."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ultragray import GaussianScene, LinearProbe, render
from ultragray.errors import InvalidArgument, SceneFileInvalid
from ultragray.exchange.ply import read_ply, write_ply
from ultragray.geometry.rotations import rotations_of
from ultragray.learn.localization.search import localize
from ultragray.learn.training.agreement import with_shares
from ultragray.scene.tissue import STICKING, FollowingTissue

PROBE = LinearProbe(width_mm=20.0, near_mm=0.0, far_mm=20.0)
SHARES = 0.25, 0.0, 0.5
SIZE = {"height": 24, "width": 20}


def hand_path(count=40, seed=None):  # [P, 4, 4] mm
    """Along y by 0.5 mm a frame, swaying; with a seed, as a tracker that shakes tells it."""
    t = np.arange(count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = rotations_of(np.radians(np.stack([np.sin(t / 9.0), np.sin(t / 7.0), np.cos(t / 11.0)], axis=1)))
    poses[:, :3, 3] = np.stack([1.5 * np.sin(t / 8.0), 0.5 * t - 10.0, np.sin(t / 6.0) - 10.0], axis=1)
    if seed is not None:
        random = np.random.default_rng(seed)
        poses[:, :3, :3] = poses[:, :3, :3] @ rotations_of(np.radians(random.normal(scale=0.2, size=(count, 3))))
        poses[:, :3, 3] += random.normal(scale=0.2, size=(count, 3))
    return poses


def tissue_of(tracked, told=None):
    at_rest = with_shares(tracked, [range(len(tracked))], PROBE, SHARES)
    errors = None if told is None else tracked @ np.linalg.inv(told)
    return at_rest, FollowingTissue(tracked, at_rest, errors, SHARES, PROBE)


def apart_mm(one, other):  # [C, 4, 4] both -> [C] of the corners
    return np.linalg.norm(PROBE.corners_from(one) - PROBE.corners_from(other), axis=-1).max(axis=1)


def beside(poses, shift_mm):  # [C, 4, 4], [3] along the axes of the probe
    moved = poses.copy()
    moved[:, :3, 3] += poses[:, :3, :3] @ np.asarray(shift_mm)
    return moved


def test_frames_of_the_sweep_and_places_between_them_lead_to_the_tissue_at_rest():
    tracked = hand_path(79)
    at_rest, _ = tissue_of(tracked)
    _, tissue = tissue_of(tracked)
    every_second = FollowingTissue(tracked[::2], at_rest[::2], None, SHARES, PROBE)
    assert apart_mm(tracked, at_rest).mean() > 1.0
    assert apart_mm(tissue.at_rest(tracked), at_rest).max() < 0.15
    assert apart_mm(every_second.at_rest(tracked), at_rest).max() < 0.25
    assert apart_mm(tissue.tracked(tissue.at_rest(tracked)), tracked).max() < 0.15


def test_far_from_the_path_the_probe_slides_over_the_tissue():
    tracked = hand_path()
    _, tissue = tissue_of(tracked)
    before, shift = tracked[10:30], np.array([2.0, 0.0, -1.0])
    moved = tissue.at_rest(beside(before, shift))
    assert apart_mm(moved, beside(tissue.at_rest(before), shift)).max() < 0.1 * np.linalg.norm(shift)


def test_tissue_sticks_to_a_probe_that_is_off_its_path_by_no_more_than_the_tracker_errs():
    tracked, told = hand_path(), hand_path(seed=1)
    at_rest, tissue = tissue_of(tracked, told)
    inner = slice(5, 35)
    for shift, share in (((0.3, 0.0, 0.0), SHARES[0]), ((0.0, 0.0, 0.3), SHARES[1]), ((0.0, 0.3, 0.0), 1.0)):
        moved = tissue.at_rest(beside(tracked[inner], shift))
        expected = beside(tissue.at_rest(tracked[inner]), share * np.asarray(shift))
        assert apart_mm(moved, expected).max() < 0.06, shift
    far = tissue.at_rest(beside(tracked[inner], (0.0, 0.0, 3.0)))
    slipped = STICKING * 0.2 * (1.0 - SHARES[1])
    expected = beside(tissue.at_rest(tracked[inner]), (0.0, 0.0, 3.0 - slipped))
    assert apart_mm(far, expected).max() < 0.35
    errors = [apart_mm(tissue.at_rest(one[inner]), at_rest[inner]).mean() for one in (tracked, told)]
    assert errors[1] - errors[0] < 0.75 * apart_mm(told[inner], tracked[inner]).mean()


def test_another_calibration_holds_for_every_pose():
    tracked, calibration = hand_path(), np.eye(4)
    calibration[:3, :3] = rotations_of(np.radians([[0.0, 0.0, 2.0]]))[0]
    calibration[:3, 3] = 0.5, 0.3, -0.8
    tissue = FollowingTissue(tracked, tracked @ calibration, None, (1.0, 1.0, 1.0), PROBE)
    for shift in ((0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0, 0.4, 1.0)):
        asked = beside(tracked[5:35], shift)
        assert apart_mm(tissue.at_rest(asked), asked @ calibration).max() < 0.03 * (1.0 + np.linalg.norm(shift)), shift
        assert apart_mm(tissue.tracked(asked @ calibration), asked).max() < 0.03 * (1.0 + np.linalg.norm(shift)), shift


@pytest.fixture
def followed(random_scene):
    scene = random_scene(count=200)
    tracked = hand_path()
    at_rest, _ = tissue_of(tracked)
    return GaussianScene.from_splats(
        scene.splats,
        info=replace(scene.info, probe=PROBE, tissue_shares=SHARES),
        training_poses=tracked,
        rest_poses=at_rest,
    )


def test_frames_are_rendered_as_the_sweep_showed_them(followed):
    poses = followed.training_poses[7:9]
    frames = render(followed, None, poses, **SIZE)
    np.testing.assert_array_equal(
        frames.bmode, render(followed.at_rest(), None, followed.tissue.at_rest(poses), **SIZE).bmode
    )
    assert not np.array_equal(frames.bmode, render(followed.at_rest(), None, poses, **SIZE).bmode)
    assert followed.at_rest().tissue is None
    np.testing.assert_array_equal(followed.at_rest().training_poses, followed.rest_poses)


def test_the_gradient_by_poses_is_that_of_a_probe_that_slides(followed):
    scene = followed.to(torch.float64)
    pose = torch.from_numpy(scene.training_poses[7]).requires_grad_()
    render(scene, None, pose, **SIZE, backend="reference").bmode.sum().backward()
    step = 1e-5
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        at_rest = scene.tissue.at_rest(scene.training_poses[7:8])
        sums = [
            render(scene.at_rest(), None, beside(at_rest, sign * shift), **SIZE, backend="reference").bmode.sum()
            for sign in (1.0, -1.0)
        ]
        along = float(pose.grad[:3, 3] @ pose.detach()[:3, axis])
        assert along == pytest.approx(float(sums[0] - sums[1]) / (2.0 * step), rel=1e-4)


def test_a_frame_is_found_where_the_tracker_would_have_told_it(followed):
    pose = followed.training_poses[20]
    frame = render(followed, None, pose, height=48, width=48).bmode[0].clamp(0.0, 1.0)
    found = localize(followed, frame, beside(pose[None], (0.5, 0.3, -0.4))[0])
    assert apart_mm(found.pose[None], pose[None]) < 0.3


def test_the_scene_file_keeps_it(followed, tmp_path):
    path = tmp_path / "followed.ugr"
    followed.save(path)
    loaded = GaussianScene.load(path)
    np.testing.assert_array_equal(loaded.rest_poses, followed.rest_poses)
    assert loaded.info.tissue_shares == SHARES
    write_ply(loaded.at_rest(), tmp_path / "at_rest.ply")
    np.testing.assert_array_equal(read_ply(tmp_path / "at_rest.ply").training_poses, followed.rest_poses)


@pytest.mark.parametrize("missing", ["tissue_shares", "rest_poses", "poses", "probe"])
def test_half_of_what_tells_of_it_is_refused(followed, tmp_path, missing):
    info = replace(followed.info, tissue_shares=None if missing == "tissue_shares" else SHARES)
    info = replace(info, probe=None if missing == "probe" else PROBE)
    if missing == "poses":
        followed = replace(followed, training_poses=followed.training_poses[:0], rest_poses=followed.rest_poses[:0])
    rest = None if missing == "rest_poses" else followed.rest_poses
    with pytest.raises(InvalidArgument, match="belong together"):
        GaussianScene.from_splats(followed.splats, info=info, training_poses=followed.training_poses, rest_poses=rest)
    damaged = replace(followed, info=info, rest_poses=rest)
    (tmp_path / "half.ugr").write_bytes(damaged.to_bytes())
    with pytest.raises(SceneFileInvalid, match="belong together"):
        GaussianScene.load(tmp_path / "half.ugr")


def test_shares_lie_between_0_and_1(followed):
    with pytest.raises(InvalidArgument, match="tissue_shares"):
        replace(followed.info, tissue_shares=(0.5, 1.5, 0.0))
