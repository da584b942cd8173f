"""Samples of a registration that contradict each other: the worst is named, and the mistake that was made."""

import cv2
import numpy as np
import pytest

from ultragray.geometry.contradictions import point_contradiction, pose_contradiction
from ultragray.geometry.registration import register_points, register_poses, register_poses_and_mounting

COUNT = 9


def motion(random, spread_mm, turn):
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(random.normal(0, turn, 3))[0]
    pose[:3, 3] = random.normal(0, spread_mm, 3)
    return pose


def samples(seed, noise_mm, noise_deg):
    """Poses of a flange and of the probe that it holds, as a tracker measures them, and the mounting."""
    random = np.random.default_rng(seed)
    base_to_scene, mounting = motion(random, 300, 1), motion(random, 80, 1)
    flanges = np.stack([motion(random, 40, 0.4) for _ in range(COUNT)])
    errors = np.stack([motion(random, noise_mm, np.radians(noise_deg)) for _ in range(COUNT)])
    return flanges, base_to_scene @ flanges @ mounting @ errors, mounting


def metres(poses):
    poses = poses.copy()
    poses[..., :3, 3] /= 1000.0
    return poses


def stale(poses):
    poses = poses.copy()
    poses[4] = poses[3]
    return poses


@pytest.mark.parametrize("noise", [(0.0, 0.0), (0.3, 0.2)])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("is_mounting_given", [True, False])
def test_each_mistake_is_named(seed, noise, is_mounting_given):
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
    assert "are inverted" in told(np.linalg.inv(flanges), probes)
    assert "flange is one sample late" in told(np.concatenate([flanges[:1], flanges[:-1]]), probes)
    if is_mounting_given:
        assert "probe_to_flange are inverted" in told(flanges, probes, np.linalg.inv(mounting))
        assert "probe_to_flange is in metres" in told(flanges, probes, metres(mounting))
    random = np.random.default_rng(9)
    nonsense = np.stack([motion(random, 40, 0.4) for _ in range(COUNT)])
    assert "the samples contradict each other: sample " in told(flanges, nonsense)


@pytest.mark.parametrize("noise_mm", [0.0, 0.4])
def test_points_that_contradict_each_other(noise_mm):
    random = np.random.default_rng(4)
    in_base, true = random.normal(0, 60, (8, 3)), motion(random, 200, 1)
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
