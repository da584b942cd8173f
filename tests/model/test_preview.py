"""The preview of late real frames, in a tissue of waves whose every frame is known."""

import itertools
from functools import cache

import numpy as np
import pytest

from ultragray.geometry.probe import LinearProbe
from ultragray.rendering.preview import AGREES, Previewer, agreement

PROBE = LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=30.0)
SIDE = 32
RATE_HZ = 20.0
SHARES = (np.arange(SIDE) + 0.5) / SIDE
PIXELS_MM = PROBE.points_mm(*np.meshgrid(SHARES, SHARES, indexing="ij")).reshape(-1, 3)


def waves(seed, count, longest_mm, shortest_mm):
    random = np.random.default_rng(seed)
    directions = random.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    lengths_mm = np.geomspace(longest_mm, shortest_mm, count)
    return 2 * np.pi * directions / lengths_mm[:, None], random.uniform(0, 2 * np.pi, count)


ANATOMY, DETAIL = waves(0, 20, 30.0, 6.0), waves(1, 20, 4.0, 2.0)


def frame(pose, *parts):
    points = PIXELS_MM @ pose[:3, :3].T + pose[:3, 3]
    grey = sum(share * np.sin(points @ turns.T + phases).sum(axis=1) for share, (turns, phases) in parts)
    return np.clip(0.5 + grey, 0, 1).reshape(SIDE, SIDE).astype(np.float32)


def drawn_once(picture):
    """The picture of a pose, which many tests ask for, as it was drawn for the first of them."""
    drawn = cache(lambda pose: picture(np.frombuffer(pose).reshape(4, 4)))
    return lambda pose: drawn(pose.tobytes())


@drawn_once
def real(pose):
    return frame(pose, (0.03, ANATOMY), (0.012, DETAIL))


@drawn_once
def scene(pose):  # which knows the anatomy alone, and is darker
    return 0.6 * frame(pose, (0.03, ANATOMY)) + 0.1


@drawn_once
def another(pose):
    return frame(pose, (0.03, waves(7, 20, 30.0, 6.0)))


def along(axis, mm_per_s):
    def pose(time_s):
        there = np.eye(4)
        there[axis, 3] = mm_per_s * (2.5 - abs(time_s % 5.0 - 2.5))  # to and fro
        return there

    return pose


def psnr(squares):
    return -10 * np.log10(max(np.mean(squares), 1e-9))


def seen(pose_at, rendered, delay_s, seconds=3.0):
    """PSNR of the late frame, of the scene's and of the preview; the told errors and the true ones."""
    preview, late, alone, shown, told = Previewer(PROBE), [], [], [], []
    back = round(delay_s * RATE_HZ)
    poses = [pose_at(k / RATE_HZ) for k in range(round(seconds * RATE_HZ))]
    for k in range(back, len(poses)):
        before, now, truth = poses[k - back], poses[k], real(poses[k])
        preview.observe(real(before), rendered(before), before)
        if k >= back + 10:
            found = preview.show(rendered(now), now)
            pictures = (real(before), rendered(now), found.frame)
            for errors, picture in zip((late, alone, shown), pictures, strict=True):
                errors.append(np.mean((picture - truth) ** 2))
            told.append(found.expected_error or 0.0)
    return psnr(late), psnr(alone), psnr(shown), np.sqrt(np.mean(np.square(told))), np.sqrt(np.mean(shown))


@pytest.mark.parametrize("delay_s", [0.05, 0.3, 1.0])
@pytest.mark.parametrize("rendered", [scene, another], ids=["scene", "another scene"])
@pytest.mark.parametrize(("mm_per_s", "axis"), [(0.0, 0), *itertools.product((0.5, 20.0), (0, 1, 2))])
def test_it_is_never_clearly_worse_than_the_late_frame(mm_per_s, axis, rendered, delay_s):
    late, _, shown, _, _ = seen(along(axis, mm_per_s), rendered, delay_s)
    assert shown >= late - 0.5


@pytest.mark.parametrize("axis", [0, 1, 2], ids=["lateral", "elevation", "axial"])
def test_at_300_ms_a_moving_robot_is_seen_five_decibels_better_and_the_error_is_told(axis):
    late, alone, shown, told, true = seen(along(axis, 20.0), scene, 0.3)
    assert shown >= max(late, alone) + 5.0
    assert told == pytest.approx(true, rel=0.3)


def test_the_share_of_a_real_frame_that_still_holds_falls_with_the_distance():
    near, far = (seen(along(1, mm_per_s), scene, 0.1)[2] for mm_per_s in (2.0, 20.0))
    assert near > far + 3.0


def test_at_rest_the_real_frame_is_shown_and_no_image_motion_told():
    preview, pose = Previewer(PROBE), np.eye(4)
    preview.observe(real(pose), scene(pose), pose)
    shown = preview.show(scene(pose), pose)
    np.testing.assert_allclose(shown.frame, real(pose), atol=0.01)
    assert (shown.moved_mm, shown.expected_error) == (0.0, None)


def test_frames_of_another_size_begin_anew():
    preview, pose = Previewer(PROBE), np.eye(4)
    preview.observe(real(pose), scene(pose), pose)
    smaller = real(pose)[::2, ::2]
    preview.observe(smaller, smaller, pose)
    np.testing.assert_allclose(preview.show(smaller, pose).frame, smaller, atol=0.05)


def test_agreement_tells_a_scene_from_another_whatever_the_gain():
    pose = along(1, 3.0)(1.0)
    assert agreement(real(pose), scene(pose)) == pytest.approx(agreement(real(pose), 0.5 * scene(pose)), abs=0.05)
    assert agreement(real(pose), scene(pose)) > 2 * AGREES
    assert agreement(real(pose), another(pose)) < AGREES
