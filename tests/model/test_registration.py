"""Registrations from points, poses and frames; what contradicts itself is told with its likely cause."""

import json

import cv2
import numpy as np
import pytest

from ultragray import render
from ultragray.errors import InvalidArgument, InvalidPose
from ultragray.geometry.contradictions import point_contradiction, pose_contradiction
from ultragray.geometry.registration import (
    Registration,
    load_registration,
    pose_residuals,
    register_points,
    register_poses,
    register_poses_and_mounting,
    rows,
    save_registration,
)
from ultragray.learn.localization.search import move_together
from ultragray.learn.registration import register_frames
from ultragray.phantom.demo import demo_poses, load_demo_scene


def motion(rng, turn_deg=60.0, shift_mm=100.0):
    pose = np.eye(4)
    axis = rng.normal(size=3)
    pose[:3, :3] = cv2.Rodrigues(np.radians(turn_deg) * axis / np.linalg.norm(axis))[0]
    pose[:3, 3] = shift_mm * rng.normal(size=3)
    return pose


def through(transform, points):
    return points @ transform[:3, :3].T + transform[:3, 3]


def test_points_without_errors_give_the_transform():
    rng = np.random.default_rng(0)
    true, points = motion(rng), 50.0 * rng.normal(size=(4, 3))
    fit = register_points(points, through(true, points))
    np.testing.assert_allclose(fit.transform, true, atol=1e-10)
    assert fit.rms_mm < 1e-10


def test_the_standard_deviations_of_points_are_those_of_many_repetitions():
    rng = np.random.default_rng(2)
    points, true = 40.0 * rng.normal(size=(8, 3)), motion(rng)
    targets = through(true, points)
    fits = [register_points(points, targets + rng.normal(scale=0.5, size=targets.shape)) for _ in range(400)]
    middles = np.array([through(fit.transform, points.mean(axis=0)[None])[0] for fit in fits])
    turns = np.array([cv2.Rodrigues(fit.transform[:3, :3] @ true[:3, :3].T)[0][:, 0] for fit in fits])
    told_mm = np.mean([fit.position_std_mm for fit in fits], axis=0)
    told_deg = np.mean([fit.angle_std_deg for fit in fits], axis=0)
    np.testing.assert_allclose(middles.std(axis=0), told_mm, rtol=0.15)
    np.testing.assert_allclose(np.degrees(turns.std(axis=0)), told_deg, rtol=0.15)


LINE = [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [2.0, 2.0, 2.0], [5.0, 5.0, 5.0]]
SPREAD = [[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [0.0, 10.0, 0.0], [0.0, 0.0, 10.0]]


@pytest.mark.parametrize(
    ("points", "targets", "told"),
    [
        (SPREAD[:2], SPREAD[:2], "points must be 3 or more, got 2"),
        (LINE, SPREAD, "points lie on a line"),
        (SPREAD, LINE, "targets lie on a line"),
        ([[1.0, 2.0, 3.0]] * 3, SPREAD[:3], "in one place"),
        (SPREAD, SPREAD[:3], "each point needs its target: got 4 and 3"),
        (SPREAD, (np.array(SPREAD) * [1, 1, -1]).tolist(), "mirror image"),
        ([[1.0, 2.0]] * 3, SPREAD[:3], r"numbers \[N, 3\], got \[3, 2\]"),
        ([[np.nan, 0.0, 0.0], *SPREAD[1:]], SPREAD, "points must be finite"),
        ("abc", SPREAD, r"points must be numbers \[N, 3\]"),
    ],
)
def test_points_that_tell_no_transform_are_refused(points, targets, told):
    with pytest.raises(InvalidArgument, match=told):
        register_points(points, targets)


def test_one_pose_gives_the_link_and_tells_no_deviations():
    rng = np.random.default_rng(4)
    base_to_scene, mounting, flange = motion(rng), motion(rng), motion(rng)
    fit = register_poses(flange, base_to_scene @ flange @ mounting, mounting)
    np.testing.assert_allclose(fit.base_to_scene, base_to_scene, atol=1e-9)
    assert fit.position_std_mm is None


def test_the_deviations_of_poses_are_those_of_many_repetitions():
    rng = np.random.default_rng(5)
    base_to_scene = motion(rng)
    flanges = np.stack([motion(rng) for _ in range(8)])
    fits = []
    for _ in range(200):
        noise = np.stack([motion(rng, rng.normal(), 0.8) for _ in flanges])
        fits.append(register_poses(flanges, base_to_scene @ flanges @ noise))
    turns = [cv2.Rodrigues(fit.base_to_scene[:3, :3] @ base_to_scene[:3, :3].T)[0][:, 0] for fit in fits]
    told_deg = np.mean([fit.angle_std_deg for fit in fits], axis=0)
    np.testing.assert_allclose(np.degrees(np.std(turns, axis=0)), told_deg, rtol=0.4)


def test_mounting_and_base_are_found_together():
    rng = np.random.default_rng(6)
    base_to_scene, mounting = motion(rng), motion(rng)
    flanges = np.stack([motion(rng) for _ in range(5)])
    fit = register_poses_and_mounting(flanges, base_to_scene @ flanges @ mounting)
    np.testing.assert_allclose(fit.base_to_scene, base_to_scene, atol=1e-8)
    np.testing.assert_allclose(fit.probe_to_flange, mounting, atol=1e-8)
    assert fit.residuals_deg.max() < 1e-5
    noisy = base_to_scene @ flanges @ mounting @ np.stack([motion(rng, 0.2, 0.2) for _ in flanges])
    found = register_poses_and_mounting(flanges, noisy)
    shift_mm, turn_deg = pose_residuals(found.probe_to_flange[None], mounting[None])
    assert shift_mm[0] < 2.0
    assert turn_deg[0] < 0.5


def test_a_mounting_that_turns_about_one_axis_cannot_tell_is_refused():
    rng = np.random.default_rng(7)
    flanges = np.tile(np.eye(4), (4, 1, 1))
    for index, turn in enumerate((0.0, 0.3, 0.7, 1.1)):
        flanges[index, :3, :3] = cv2.Rodrigues(np.array([0.0, 0.0, turn]))[0]
        flanges[index, :3, 3] = rng.normal(size=3)
    with pytest.raises(InvalidArgument, match="about each of two axes"):
        register_poses_and_mounting(flanges, flanges)
    with pytest.raises(InvalidArgument, match="3 to 200 poses"):
        register_poses_and_mounting(flanges[:2], flanges[:2])
    with pytest.raises(InvalidArgument, match="got 4 and 2"):
        register_poses(flanges, flanges[:2])


def test_frames_register_a_robot_and_one_foreign_frame_does_no_harm():
    scene, rng = load_demo_scene(), np.random.default_rng(8)
    true, mounting = motion(rng, 90.0, 200.0), motion(rng, 180.0, 50.0)
    poses = demo_poses(7)[1:6]
    frames = render(scene, None, poses, height=128, width=128, outputs=("bmode",))["bmode"].detach().numpy()
    flanges = np.linalg.inv(true) @ poses @ np.linalg.inv(mounting)
    images = [*frames[:4], frames[0]]  # the last image is not that of its pose
    off = motion(rng, 2.0, 0.0)
    off[:3, 3] = poses[2, :3, 3] - off[:3, :3] @ poses[2, :3, 3] + (1.0, -0.8, 0.9)
    found = register_frames(scene, images, flanges, off @ true, probe_to_flange=mounting)
    assert found.agreeing == (0, 1, 2, 3)
    shifts_mm, turns_deg = pose_residuals(found.fit.base_to_scene @ flanges @ mounting, poses)
    assert shifts_mm.max() < 0.3
    assert turns_deg.max() < 0.3


def test_one_motion_of_all_frames_is_found_by_all_of_them():
    """Frames so small and few of structures that none tells its own place so well."""
    scene, rng = load_demo_scene(), np.random.default_rng(10)
    poses = demo_poses(7)[1:6:2]
    frames = render(scene, None, poses, height=96, width=72, outputs=("bmode",))["bmode"].detach().numpy()
    off = motion(rng, 1.5, 0.0)
    off[:3, 3] = poses[1, :3, 3] - off[:3, :3] @ poses[1, :3, 3] + (0.5, -0.6, 0.4)
    moved = move_together(scene, list(frames), off @ poses) @ off
    shifts_mm, turns_deg = pose_residuals(moved @ poses, poses)
    assert shifts_mm.max() < 0.1
    assert turns_deg.max() < 0.1


def test_frames_that_show_nothing_are_told():
    scene, noise = load_demo_scene(), np.random.default_rng(0)
    images = [noise.random((64, 64)) for _ in range(3)]
    with pytest.raises(InvalidArgument, match="of 3 frames were found"):
        register_frames(scene, images, demo_poses(3), np.eye(4))
    with pytest.raises(InvalidArgument, match="images must be 3 or more"):
        register_frames(scene, images[:2], demo_poses(2), np.eye(4))


def test_a_registration_leads_poses_into_the_scene_and_survives_its_file(tmp_path):
    rng = np.random.default_rng(9)
    base_to_scene, mounting = motion(rng), motion(rng)
    registration = Registration(
        base_to_scene=rows(base_to_scene),
        probe_to_flange=rows(mounting),
        residual_mm=0.4,
        angle_std_deg=(0.1, 0.2, 0.3),
    )
    flanges = np.stack([motion(rng) for _ in range(3)])
    np.testing.assert_allclose(registration.probe_to_scene(flanges), base_to_scene @ flanges @ mounting)
    path = tmp_path / "robot.json"
    save_registration(path, registration)
    assert load_registration(path) == registration


@pytest.mark.parametrize(
    ("document", "told"),
    [
        ("no json", "Expecting value"),
        ("[]", "no object"),
        (json.dumps({"format_version": 2}), "a newer release wrote it"),
        (json.dumps({"format_version": 1}), "base_to_scene is required"),
        (json.dumps({"format_version": 1, "base_to_scene": np.ones((4, 4)).tolist()}), "base_to_scene must"),
        (json.dumps({"format_version": 1, "base_to_scene": [[1, 2], [3, 4]]}), "a list of 4 values"),
    ],
)
def test_a_file_that_is_no_registration_is_refused(document, told, tmp_path):
    path = tmp_path / "robot.json"
    path.write_text(document)
    with pytest.raises(InvalidArgument, match=told):
        load_registration(path)


def test_a_mirrored_link_is_refused():
    with pytest.raises(InvalidPose, match="mirrored"):
        Registration(base_to_scene=rows(np.diag([1.0, 1.0, -1.0, 1.0])))


SAMPLES = 9


def scattered(random, spread_mm, turn):
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(random.normal(0, turn, 3))[0]
    pose[:3, 3] = random.normal(0, spread_mm, 3)
    return pose


def samples(seed, noise_mm, noise_deg):
    """Poses of a flange and of the probe that it holds, as a tracker measures them, and the mounting."""
    random = np.random.default_rng(seed)
    base_to_scene, mounting = scattered(random, 300, 1), scattered(random, 80, 1)
    flanges = np.stack([scattered(random, 40, 0.4) for _ in range(SAMPLES)])
    errors = np.stack([scattered(random, noise_mm, np.radians(noise_deg)) for _ in range(SAMPLES)])
    return flanges, base_to_scene @ flanges @ mounting @ errors, mounting


def metres(poses):
    poses = poses.copy()
    poses[..., :3, 3] /= 1000.0
    return poses


def stale(poses):
    poses = poses.copy()
    poses[4] = poses[3]
    return poses


@pytest.mark.parametrize(("is_mounting_given", "seed", "noise"), [(True, 0, (0.0, 0.0)), (False, 1, (0.3, 0.2))])
def test_each_mistake_is_named(is_mounting_given, seed, noise):
    flanges, probes, mounting = samples(seed, *noise)

    def told(flanges, probes, mounting=mounting):
        fit = (
            register_poses(flanges, probes, mounting)
            if is_mounting_given
            else register_poses_and_mounting(flanges, probes)
        )
        return pose_contradiction(fit, flanges, probes, is_mounting_given=is_mounting_given) or ""

    assert told(flanges, probes) == ""
    assert "samples 2 and 5 are exchanged" in told(flanges, probes[[0, 1, 5, 3, 4, 2, 6, 7, 8]])
    assert "sample 4 alone is wrong, flange is that of sample 3: a stale one" in told(stale(flanges), probes)
    assert "sample 4 alone is wrong, probe is that of sample 3" in told(flanges, stale(probes))
    assert "positions of flange are in metres" in told(metres(flanges), probes)
    assert "positions of probe are in metres" in told(flanges, metres(probes))
    assert "flange are inverted" in told(np.linalg.inv(flanges), probes)
    assert "probe are inverted" in told(flanges, np.linalg.inv(probes))
    assert "positions in metres?" in told(metres(flanges), metres(probes), metres(mounting))
    for far_mm in (7.0, 20.0):  # the residuals of the first are within what hands measure
        slipped = probes + np.linspace(0, far_mm, SAMPLES)[:, None, None] * np.outer([0.6, 0.8, 0, 0], [0, 0, 0, 1])
        assert "the probe slipped or a tracker drifts, by " in told(flanges, slipped)
    assert "flange is one sample late" in told(np.concatenate([flanges[:1], flanges[:-1]]), probes)
    if is_mounting_given:
        assert "probe_to_flange are inverted" in told(flanges, probes, np.linalg.inv(mounting))
        assert "positions of probe_to_flange are in metres" in told(flanges, probes, metres(mounting))
        assert "poses of flange and probe are inverted" in told(np.linalg.inv(flanges), np.linalg.inv(probes))
    random = np.random.default_rng(9)
    nonsense = np.stack([scattered(random, 40, 0.4) for _ in range(SAMPLES)])
    assert "the samples contradict each other: sample " in told(flanges, nonsense)


@pytest.mark.parametrize("noise_mm", [0.0, 0.4])
def test_points_that_contradict_each_other(noise_mm):
    random = np.random.default_rng(4)
    in_base, true = random.normal(0, 60, (8, 3)), scattered(random, 200, 1)
    in_scene = in_base @ true[:3, :3].T + true[:3, 3] + random.normal(0, noise_mm, (8, 3))

    def told(in_base, in_scene):
        return point_contradiction(register_points(in_base, in_scene), in_base, in_scene) or ""

    assert told(in_base, in_scene) == ""
    assert "samples 1 and 6 are exchanged" in told(in_base, in_scene[[0, 6, 2, 3, 4, 5, 1, 7]])
    assert "positions of base are in metres" in told(in_base / 1000, in_scene)
    wrong = in_scene.copy()
    wrong[3] += 25.0
    assert "sample 3, the worst" in told(in_base, wrong)
    assert "sample 3 alone is wrong" in told(in_base, wrong)
