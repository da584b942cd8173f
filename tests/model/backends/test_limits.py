"""The cost of a frame is told before it is drawn, and a flag ends a rendering in the middle, on every backend."""

import threading

import numpy as np
import pytest
import torch

from ultragray import GaussianScene, render
from ultragray.errors import FrameTooCostly
from ultragray.rendering.backends import reference
from ultragray.rendering.frames import footprint_pixels
from ultragray.rendering.limits import GivenUp, Limits

from .conftest import CONVEX, HEIGHT, LINEAR, PHASED, RADIAL, WIDTH

PROBES = [LINEAR, CONVEX, PHASED, RADIAL]
BACKENDS = ["reference", "cpu", pytest.param("cuda", marks=pytest.mark.slow)]
SIZE = {"height": HEIGHT, "width": WIDTH}


def placed(scene, backend, on_device):
    return on_device(scene) if backend == "cuda" else scene


def wide_scene(count, log_scale):
    """Gaussians of e^log_scale cm before the probe."""
    random = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=random) * torch.tensor([4.0, 1.0, 4.0]) + torch.tensor([-2.0, -0.5, 0.5])
    splats = {
        "means": means,
        "scales": torch.full((count, 3), log_scale),
        "quats": torch.ones(count, 4),
        "transmittances": torch.zeros(count),
        "sh0": torch.zeros(count, 1, 1),
    }
    return GaussianScene.from_splats(splats)


@pytest.mark.parametrize("probe", PROBES, ids=lambda probe: probe.kind)
def test_no_footprint_is_counted_too_small(probe, random_scene, random_poses):
    """Against the pixels where the reference finds a weight or an absorption, Gaussian by Gaussian."""
    scene, poses = random_scene(30, sigma_cm=(0.02, 0.5)), random_poses(4)
    touched = np.zeros(len(poses))
    for i in range(30):
        alone = GaussianScene.from_splats({name: tensor[i : i + 1] for name, tensor in scene.splats.items()})
        inside = alone.poses_to_scene_cm(poses)
        weights = reference.render_outputs(alone, probe, inside, **SIZE, outputs=("coverage",))["coverage"]
        touched += (weights >= 1 / 256).sum(dim=(1, 2)).numpy()
    costs = np.array(footprint_pixels(scene, probe, poses, **SIZE))
    assert touched.max() > 100
    assert (costs >= touched).all()


@pytest.mark.parametrize("probe", PROBES, ids=lambda probe: probe.kind)
def test_wider_gaussians_cost_more_until_they_fill_the_frame(probe):
    pose = np.eye(4)
    costs = [footprint_pixels(wide_scene(100, scale), probe, pose, **SIZE)[0] for scale in (-5.0, -2.0, 0.0, 5.0, 20.0)]
    assert sorted(costs) == costs
    assert costs[0] < costs[3] / 5
    assert costs[3] == pytest.approx(costs[4], rel=0.1)  # as many pixels as there are, for each
    assert costs[4] >= 100 * 37 * 53 / 4  # of what is before the probe


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_frame_over_the_limit_is_refused_and_names_both(backend, on_device):
    scene = placed(wide_scene(100, 5.0), backend, on_device)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:2, 2, 3] = 1e4  # nothing is before the probe there
    with pytest.raises(
        FrameTooCostly, match=r"may cost 1 million footprint pixels, this one would about \d"
    ) as refused:
        render(scene, LINEAR, poses, backend=backend, limits=Limits(footprint_pixels=1_000_000), **SIZE)
    assert refused.value.field == "poses[2]"
    render(scene, LINEAR, poses, backend=backend, limits=Limits(footprint_pixels=10_000_000), **SIZE)


@pytest.mark.slow
def test_backends_agree_on_the_cost(random_scene, on_device):
    """Each refuses what the CPU's count says is three times its limit, and draws what is a third of it."""
    scene = on_device(random_scene(50))
    for probe in (LINEAR, CONVEX):
        (cost,) = footprint_pixels(scene, probe, np.eye(4), **SIZE)
        assert cost > 0
        render(scene, probe, np.eye(4), backend="cuda", limits=Limits(3 * cost), **SIZE)
        with pytest.raises(FrameTooCostly):
            render(scene, probe, np.eye(4), backend="cuda", limits=Limits(cost // 3), **SIZE)


def test_hostile_scenes_are_refused_before_they_are_drawn():
    """Gaussians of 148 cm and of e^20 cm, which would take minutes."""
    for log_scale in (5.0, 20.0):
        scene = wide_scene(50_000, log_scale)
        with pytest.raises(FrameTooCostly):
            render(scene, LINEAR, np.eye(4), height=512, width=512, limits=Limits(footprint_pixels=2**31))


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_raised_flag_ends_a_rendering_before_it_begins(backend, random_scene, on_device):
    scene = placed(random_scene(20), backend, on_device)
    flag = np.zeros(1, np.int64)
    limits = Limits(flag=flag, number=7)
    render(scene, LINEAR, np.eye(4), backend=backend, limits=limits, **SIZE)
    flag[0] = 6  # which ended an earlier one
    render(scene, LINEAR, np.eye(4), backend=backend, limits=limits, **SIZE)
    flag[0] = 7
    with pytest.raises(GivenUp):
        render(scene, LINEAR, np.eye(4), backend=backend, limits=limits, **SIZE)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_a_flag_raised_in_the_middle_ends_a_frame_of_minutes(backend):
    scene = wide_scene(200_000, 2.0)
    render(scene, LINEAR, np.eye(4), backend="cpu", height=1, width=1)  # sorts it
    flag = np.zeros(1, np.int64)
    raising = threading.Timer(0.5, flag.fill, [1])  # into the frame
    raising.start()
    with pytest.raises(GivenUp):
        render(scene, LINEAR, np.eye(4), backend=backend, height=512, width=512, limits=Limits(flag=flag, number=1))
    raising.join()
