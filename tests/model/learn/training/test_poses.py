"""Pose refinement: errors that were put in come out, good poses stay, and a run with corrections can be resumed."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ultragray import GaussianScene, LinearProbe
from ultragray.geometry.rotations import rotations_of
from ultragray.learn.report.sizes import CorrectionSizes
from ultragray.learn.sweep import Dataset, Sweep
from ultragray.learn.training import train
from ultragray.learn.training.alignment import (
    likelihood_terms,
    register_sweeps,
    smoothed,
    sweep_ranges,
    tracker_noise,
    without_noise,
)
from ultragray.learn.training.poses import PoseRefinement, SweepCorrections, turned_by
from ultragray.scene.info import SceneHeader, SceneInfo

from ..conftest import make_tiny_config, make_tiny_dataset

PROBE = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0)


def poses_of(turns_deg, positions_mm):
    poses = np.tile(np.eye(4), (len(turns_deg), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations_of(np.radians(turns_deg)), positions_mm
    return poses


def freehand_path(count, *, start_mm=0.0, tilt_deg=0.0):  # [F, 4, 4]
    """Along y, with slow swaying and uneven steps."""
    t = np.linspace(0.0, 1.0, count)
    turns = np.stack([tilt_deg + 3.0 * t, 2.0 * np.sin(3.0 * t), t * 0.0], axis=1)
    steps = 0.5 + 0.4 * (np.arange(count) % 7 == 3)
    return poses_of(turns, np.stack([2.0 * t * t, start_mm + np.cumsum(steps), np.sin(2.0 * t)], axis=1))


def shaken(poses, mm, deg):
    rng = np.random.default_rng(0)
    errors = poses_of(rng.normal(0.0, deg, (len(poses), 3)), rng.normal(0.0, mm, (len(poses), 3)))
    return np.asarray(poses @ errors)


def tissue(points):  # [..., 3] mm -> [...] grey
    """Speckle-like structure of some millimetres that is the same from everywhere."""
    rng = np.random.default_rng(3)
    waves = rng.normal(0.0, 0.9, (40, 3))
    phases = rng.uniform(0.0, 2.0 * np.pi, 40)
    return np.asarray(np.clip(110.0 + 18.0 * np.cos(points @ waves.T + phases).sum(axis=-1), 0.0, 255.0))


def seen(poses, height=48, width=40):
    rows, columns = (np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width
    down, right = np.meshgrid(rows, columns, indexing="ij")
    points = np.einsum("fij,hwj->fhwi", poses[:, :3, :3], PROBE.points_mm(down, right)) + poses[:, None, None, :3, 3]
    return Sweep(tissue(points).astype(np.uint8), poses, PROBE, np.arange(len(poses)), "tissue")


def angle_deg(rotation):
    return float(np.degrees(np.arccos(np.clip((np.trace(rotation) - 1.0) / 2.0, -1.0, 1.0))))


def test_no_turn_has_a_gradient():
    turns = torch.zeros((1, 3), dtype=torch.float64, requires_grad=True)
    turned_by(turns)[0, 2, 1].backward()
    assert turns.grad.tolist() == [[1.0, 0.0, 0.0]]


def test_sweeps_are_told_apart_by_the_jump_of_the_path():
    poses = np.concatenate([freehand_path(40), freehand_path(30, start_mm=-30.0), freehand_path(3, start_mm=90.0)])
    assert sweep_ranges(seen(poses)) == [range(40), range(40, 73)]  # three frames are no sweep of their own


@pytest.mark.parametrize("shake_mm", [0.0, 0.02])
def test_a_probe_that_rests_does_not_begin_a_new_sweep_with_each_step(shake_mm):
    rested = freehand_path(40)[[*range(20), *[20] * 100, *range(20, 40)]]
    assert sweep_ranges(seen(shaken(rested, shake_mm, 0.0))) == [range(140)]


@pytest.mark.parametrize("total_deg", [170.0, 360.0, 800.0])
def test_the_noise_of_a_probe_that_turns_far_is_measured_and_removed(total_deg):
    count = 120
    true = freehand_path(count) @ poses_of(np.linspace(0.0, total_deg, count)[:, None] * [[0.0, 0.0, 1.0]], [[0.0] * 3])
    given, ranges = shaken(true, 0.6, 0.6), [range(count)]
    noise = tracker_noise(given, ranges)
    assert noise.turn_deg == pytest.approx(0.6, rel=0.25)
    errors = [
        np.array([angle_deg(a[:3, :3] @ b[:3, :3].T) for a, b in zip(some, true, strict=True)])
        for some in (given, without_noise(given, ranges))
    ]
    assert errors[1].mean() < 0.5 * errors[0].mean()
    assert errors[1].max() < 0.8 * errors[0].max()


@pytest.mark.parametrize(("mm", "deg"), [(0.6, 0.6), (1.0, 0.5)])
def test_the_noise_of_a_tracker_is_measured_and_removed(mm, deg):
    true = freehand_path(120)
    given, ranges = shaken(true, mm, deg), [range(120)]
    noise = tracker_noise(given, ranges)
    assert min(noise.axes_mm) == noise.position_mm
    assert noise.position_mm == pytest.approx(mm, rel=0.25)
    assert noise.turn_deg == pytest.approx(deg, rel=0.25)
    found = without_noise(given, ranges)

    def steps_deg(poses):
        moves, wanted = (np.linalg.inv(some[:-1]) @ some[1:] for some in (poses, true))
        return np.array([angle_deg(a[:3, :3] @ b[:3, :3].T) for a, b in zip(moves, wanted, strict=True)])

    assert np.abs(found[:, :3, 3] - true[:, :3, 3]).mean() < 0.45 * np.abs(given[:, :3, 3] - true[:, :3, 3]).mean()
    assert steps_deg(found).mean() < 0.1 * steps_deg(given).mean()


def test_an_error_that_changes_slowly_is_taken_for_the_path():
    """A drift of some mm and degrees along a sweep is as smooth as a hand: nothing is taken off."""
    t = np.linspace(0.0, 1.0, 120)
    drift = poses_of(
        np.stack([2.0 * t, -1.5 * np.sin(4.0 * t), t * t], axis=1),
        np.stack([3.0 * np.sin(3.0 * t), 2.0 * t * t, -4.0 * t], axis=1),
    )
    given = np.asarray(drift @ freehand_path(120))
    noise = tracker_noise(given, [range(120)])
    assert max(noise.position_mm, noise.turn_deg) < 0.02
    moved = without_noise(given, [range(120)]) - given
    assert np.abs(moved[:, :3, 3]).max() < 0.05
    assert np.abs(moved[:, :3, :3]).max() < np.radians(0.05)


def test_sweeps_that_overlap_little_are_left_alone():
    """The last millimetres of one sweep and the first of the next agree by chance almost anywhere."""
    first, error = freehand_path(40), poses_of(np.zeros((1, 3)), np.array([[1.5, 0.0, -1.0]]))[0]
    sweep = seen(np.concatenate([first, error @ freehand_path(40, start_mm=first[-6, 1, 3])]))
    np.testing.assert_array_equal(register_sweeps(sweep, [range(40), range(40, 80)]), np.tile(np.eye(4), (2, 1, 1)))


def test_good_poses_are_left_alone(tiny_dataset):
    dataset = tiny_dataset(frames=24)
    refinement = PoseRefinement.of(dataset, "frames")
    assert refinement.dataset is dataset
    assert refinement.of_scene()["pose_corrections"] is None
    assert refinement.group_count == 0


def noisy(dataset):
    return replace(dataset, train=replace(dataset.train, poses=shaken(dataset.train.poses, 0.6, 0.6)))


@pytest.fixture(scope="module")
def corrected():
    """A dataset with noisy poses, the settings that correct them, and the scene."""
    dataset, config = noisy(make_tiny_dataset(frames=40)), make_tiny_config(refine_poses="frames")
    return dataset, config, train(dataset, config)


def test_corrections_are_trained_and_stored(corrected, tmp_path):
    dataset, _, scene = corrected
    np.testing.assert_allclose(scene.pose_corrections @ dataset.train.poses, scene.training_poses, atol=1e-9)
    before_training = PoseRefinement.of(dataset, "frames").of_scene()["training_poses"]
    assert np.abs(scene.training_poses - before_training).max() > 1e-5
    scene.save(tmp_path / "scene.ugr")
    again = GaussianScene.load(tmp_path / "scene.ugr")
    np.testing.assert_array_equal(again.pose_corrections, scene.pose_corrections)


def test_whole_sweeps_are_trained_but_for_the_first():
    sweep, ranges = seen(freehand_path(12)), [range(6), range(6, 12)]
    corrections, true = SweepCorrections(sweep, ranges), torch.from_numpy(sweep.poses[:, :3, 3]) + 0.2
    for _ in range(40):
        found = corrections.corrected(torch.arange(12), sweep.poses)[:, :3, 3]
        (found - true).square().sum().backward()
        corrections.step(0.5)
    motions = corrections.all_motions()
    (corrections.corrected(torch.arange(12), sweep.poses) ** 2).sum().backward()
    corrections.step(1.0)
    np.testing.assert_array_equal(corrections.all_motions(), motions, "at the end of a run nothing moves any more")
    np.testing.assert_array_equal(motions[:6], np.tile(np.eye(4), (6, 1, 1)))
    np.testing.assert_array_equal(motions[7:], np.broadcast_to(motions[6], (5, 4, 4)))
    left = (motions @ sweep.poses)[6:, :3, 3] - true[6:].numpy()
    assert np.abs(left).mean() < 0.1


@pytest.mark.long
def test_a_run_brings_back_a_sweep_that_is_off_as_a_whole(tiny_config):
    true = np.concatenate([freehand_path(40, tilt_deg=-6.0), freehand_path(40, start_mm=-1.7, tilt_deg=6.0)])
    error = poses_of(np.array([[1.0, -1.5, 1.0]]), np.array([[2.0, -1.0, -2.5]]))[0]
    given = true.copy()
    given[40:] = error @ true[40:]
    train_part = replace(seen(true), poses=given)
    dataset = Dataset("tissue", train_part, train_part.select([]))
    scene = train(dataset, tiny_config(refine_poses="sweeps"))
    assert scene.pose_corrections is not None
    before_training = PoseRefinement.of(dataset, "sweeps").of_scene()["training_poses"]
    assert np.abs(scene.training_poses[40:] - before_training[40:]).max() > 1e-5
    np.testing.assert_array_equal(scene.training_poses[:40], given[:40])
    middles = replace(train_part, poses=true).corners_mm()[40:].mean(axis=1)

    def off_mm(poses):
        moves = poses[40:] @ np.linalg.inv(true[40:])
        return float(np.linalg.norm(np.einsum("fij,fj->fi", moves[:, :3, :3], middles) + moves[:, :3, 3] - middles))

    assert off_mm(scene.training_poses) < 0.25 * off_mm(given)


def test_a_scene_without_corrections_holds_no_tensor_of_them(tiny_dataset, tiny_config):
    scene = train(tiny_dataset(), tiny_config())
    assert scene.pose_corrections is None
    assert b"pose_corrections" not in scene.to_bytes()


def test_a_resumed_run_gives_the_same_corrections(corrected, tmp_path):
    (dataset, config, whole), steps = corrected, []

    def seen_step(progress):
        steps.append(progress)

    train(dataset, config, folder=tmp_path, report=seen_step, should_stop=lambda: len(steps) == 9)
    resumed = train(dataset, config, folder=tmp_path, resume=True)
    np.testing.assert_array_equal(resumed.training_poses, whole.training_poses)
    assert torch.equal(resumed.means, whole.means)


def test_the_sizes_of_corrections():
    corrections = poses_of(np.array([[0.0, 0.0, 3.0], [0.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]]))
    scene = SceneHeader(SceneInfo(), corrections, 0)
    assert CorrectionSizes.of(scene) is None
    corrected = replace(scene, pose_corrections=corrections)
    at_rest = replace(scene, training_poses=np.tile(np.eye(4), (2, 1, 1)), rest_poses=corrections)
    for sizes in map(CorrectionSizes.of, (corrected, at_rest)):
        np.testing.assert_allclose(sizes.shift_mm, [0.0, 5.0], atol=1e-9)
        np.testing.assert_allclose(sizes.turn_deg, [3.0, 0.0], atol=1e-9)
    assert str(sizes) == (
        "poses of 2 training frames were corrected by 2.50 mm (at most 5.00) and 1.50° (at most 3.00) on average"
    )


RATIOS = np.array([1e-6, 1e-2, 1.0, 1e6])


def differences(count):  # [F − 2, F]
    return np.diff(np.eye(count), 2, axis=0)


@pytest.mark.parametrize("count", [5, 40])
def test_likelihoods_are_those_of_dense_matrices(count):
    d, bends = differences(count), np.random.default_rng(0).normal(size=(count - 2, 6))
    log_determinants, squares = likelihood_terms(bends, RATIOS)
    for place, ratio in enumerate(RATIOS):
        covariance = ratio * np.eye(count - 2) + d @ d.T
        np.testing.assert_allclose(log_determinants[place], np.linalg.slogdet(covariance)[1], rtol=1e-8, atol=1e-8)
        expected = (bends * np.linalg.solve(covariance, bends)).sum(axis=0)
        np.testing.assert_allclose(squares[place], expected, rtol=1e-6)


@pytest.mark.parametrize("ratio", RATIOS)
@pytest.mark.parametrize("count", [5, 40])
def test_the_smooth_path_is_that_of_a_dense_matrix(count, ratio):
    d, values = differences(count), np.random.default_rng(1).normal(size=count).cumsum()
    expected = np.linalg.solve(np.eye(count) + d.T @ d / ratio, values)
    np.testing.assert_allclose(smoothed(values, ratio), expected, rtol=1e-6, atol=1e-6)
