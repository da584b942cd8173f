"""The simulated hand: each error is what it says, and without any the recording is the truth."""

import numpy as np
import pytest

from ultragray.geometry.rotations import turns_of
from ultragray_studies.hand import FRAME_S, PROBE, SPACING_MM, Errors, HandSweep, held_out_places

FRAMES = 5


@pytest.fixture(scope="module")
def sweep():
    return HandSweep.of((0.0, 90.0), FRAMES)


def poses_in_order(dataset):
    numbers = np.concatenate([dataset.train.frame_numbers, dataset.val.frame_numbers])
    return np.concatenate([dataset.train.poses, dataset.val.poses])[np.argsort(numbers)]


def motions(sweep, errors):
    """Of the probe in its own frame, from the truth to what is given: mm and degrees [F, 3] both."""
    found = np.linalg.inv(sweep.poses) @ poses_in_order(sweep.recorded(errors))
    return found[:, :3, 3], np.degrees(turns_of(found[:, :3, :3]))


def test_without_errors_it_is_the_truth(sweep):
    given = sweep.recorded(Errors())
    np.testing.assert_allclose(poses_in_order(given), sweep.poses, atol=1e-12)
    np.testing.assert_array_equal(given.val.frame_numbers, held_out_places(FRAMES, 2))
    np.testing.assert_array_equal(given.train.images, sweep.images[given.train.frame_numbers])
    assert given.is_one_recording
    steps = np.linalg.norm(np.diff(sweep.poses[:FRAMES, :3, 3], axis=0), axis=1)
    assert 0.5 * SPACING_MM < steps.mean() < 2.0 * SPACING_MM
    turned = turns_of(sweep.poses[:1, :3, :3].transpose(0, 2, 1) @ sweep.poses[FRAMES:, :3, :3])
    assert np.degrees(np.linalg.norm(turned, axis=1)).mean() == pytest.approx(90.0, abs=30.0)


def test_noise_is_new_in_every_frame(sweep):
    shifts, turns = motions(sweep, Errors(noise_mm=0.2, noise_deg=0.4))
    assert shifts.std() == pytest.approx(0.2, rel=0.5)
    assert turns.std() == pytest.approx(0.4, rel=0.5)
    assert np.diff(shifts, axis=0).std() > shifts.std()
    slow, _ = motions(sweep, Errors(wander_mm=0.2))
    assert np.diff(slow[:FRAMES], axis=0).std() < 0.3 * 0.2


def test_a_delay_gives_the_poses_of_a_later_time(sweep):
    given = poses_in_order(sweep.recorded(Errors(delay_ms=1000.0 * FRAME_S)))
    np.testing.assert_allclose(given[: FRAMES - 1], sweep.poses[1:FRAMES], atol=1e-9)


def test_a_calibration_is_off_alike_in_every_frame(sweep):
    shifts, turns = motions(sweep, Errors(calibration_mm=1.0, calibration_deg=2.0))
    assert np.ptp(shifts, axis=0).max() < 1e-9
    assert np.linalg.norm(shifts, axis=1) == pytest.approx(1.0)
    assert np.linalg.norm(turns, axis=1) == pytest.approx(2.0)


def test_tissue_goes_along_less_with_depth(sweep):
    given, rigid = sweep.recorded(Errors(tissue=1.0)), sweep.recorded(Errors())
    np.testing.assert_array_equal(given.train.poses, rigid.train.poses)
    changed = np.abs(given.train.images.astype(float) - rigid.train.images).mean(axis=(0, 2))
    assert changed[:40].mean() > 0.0
    still = sweep.recorded(Errors(tissue=1e-6))
    np.testing.assert_allclose(still.train.images, rigid.train.images, atol=1)
    assert PROBE.width_mm == 40.0
