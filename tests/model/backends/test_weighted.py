"""Sums over weighted Gaussians: their meaning by the reference, the same by every kernel, their gradients."""

import numpy as np
import pytest
import torch

from ultragray import GaussianScene, SceneInfo, render
from ultragray.errors import BackendUnavailable
from ultragray.rendering.backends import cpu, cuda
from ultragray.rendering.backends.inputs import scene_poses
from ultragray.rendering.backends.registry import WeightedSums, weighted_sums
from ultragray.rendering.outputs import SUMS

from .conftest import CONVEX, HEIGHT, KERNELS, LINEAR, RADIAL, WIDTH

PROBES = {"linear": LINEAR, "convex": CONVEX, "radial": RADIAL}
WEIGHTS = {"transmittance_logit": (-4.0, 4.0), "intensity": "sigmoid", "sh_degree": 0, "sigma_cm": (0.05, 0.4)}


def sums(kernel, scene, probe, poses):
    inside = scene_poses(scene, poses)
    if kernel == "reference":
        return weighted_sums(scene, probe, inside, HEIGHT, WIDTH, "reference")
    if kernel == "cuda":
        there = scene.to(cuda.device())
        return weighted_sums(there, probe, inside, HEIGHT, WIDTH, "cuda")
    planes = cpu.render_outputs(scene, probe, inside, HEIGHT, WIDTH, SUMS, weighted=True, instruction_set=kernel)
    return WeightedSums(*planes.values())


def gradients(kernel, scene, probe, poses, weights):
    """Of the sums, weighted [2, C, H, W], by raw parameter."""
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in scene.splats.items()}
    drawn = torch.stack(sums(kernel, GaussianScene.from_splats(leaves, info=scene.info), probe, poses))
    (drawn * weights.to(drawn)).sum().backward()
    return {name: leaf.grad.cpu().double().numpy() for name, leaf in leaves.items() if leaf.grad is not None}


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("name", PROBES)
def test_sums_and_gradients_are_those_of_the_reference_in_float64(name, kernel, random_scene, random_poses):
    scene, poses = random_scene(80, seed=3, centre_cm=(0, 0, 2), **WEIGHTS), random_poses(1, seed=5)
    exact_scene = scene.to(torch.float64)
    exact = torch.stack(sums("reference", exact_scene, PROBES[name], poses))
    got = torch.stack(sums(kernel, scene, PROBES[name], poses)).cpu()
    stable = (got - exact).abs() < 2e-4  # elsewhere a threshold of 1/255 flips
    assert stable.float().mean() > 0.999
    assert (got - exact).abs().max() < 5e-3
    weights = torch.randn(exact.shape, generator=torch.Generator().manual_seed(1)) * stable
    want = gradients("reference", exact_scene, PROBES[name], poses, weights)
    found = gradients(kernel, scene, PROBES[name], poses, weights)
    for parameter in ("means", "scales", "quats", "transmittances", "sh0"):
        error = np.linalg.norm(found[parameter] - want[parameter]) / np.linalg.norm(want[parameter])
        assert error < 1e-3, f"{parameter}: relative L2 error {error:.2g}"


def one_gaussian(weight):
    splats = {
        "means": torch.tensor([[0.0, 0.0, 2.5]]),
        "scales": torch.full((1, 3), 0.3).log(),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        "transmittances": torch.logit(torch.tensor([weight])),
        "sh0": torch.zeros(1, 1, 1),
    }
    return GaussianScene.from_splats(splats, info=SceneInfo(intensity="sigmoid"))


@pytest.mark.parametrize("kernel", ["reference", *KERNELS])
def test_a_weight_scales_what_a_gaussian_adds(kernel):
    pose = np.eye(4)[None]
    whole, some = (sums(kernel, one_gaussian(w), PROBES["linear"], pose) for w in (0.99999, 0.25))
    bright = some.weight > 1.01 / 255.0  # below, the weaker one is skipped
    assert bright.any()
    np.testing.assert_allclose(some.weight[bright].cpu(), 0.25 * whole.weight[bright].cpu(), rtol=2e-3)
    np.testing.assert_allclose(some.intensity.cpu(), 0.5 * some.weight.cpu(), rtol=1e-5)


@pytest.mark.parametrize("kernel", ["reference", *KERNELS])
def test_weighted_gaussians_cast_no_tail_below_themselves(kernel):
    """An absorbing Gaussian counts below itself, where its weight has fallen under 1/255; a weighted one does not."""
    scene, pose = one_gaussian(0.9), np.eye(4)[None]
    drawn = sums(kernel, scene, PROBES["linear"], pose).weight
    assert float(drawn[drawn > 0].min()) >= 0.999 / 255.0


@pytest.mark.parametrize("kernel", ["reference", *KERNELS])
def test_weights_of_one_give_the_echo_of_a_scene_over_its_coverage(kernel, random_scene, random_poses):
    scene = random_scene(150, seed=3, sigma_cm=(0.05, 0.2), sh_degree=0, intensity="sigmoid")
    poses = random_poses(2, seed=5)
    ordinary = render(scene, PROBES["linear"], poses, height=HEIGHT, width=WIDTH, outputs=("echo", "coverage"))
    ones = {**scene.splats, "transmittances": torch.full((150,), 30.0)}
    total, weighed = sums(kernel, GaussianScene.from_splats(ones, info=scene.info), PROBES["linear"], poses)
    dense = (total > 0.4).cpu()  # else the tails that an absorbing Gaussian has and a weighted one has not would show
    got, want = (weighed / total).cpu()[dense], (ordinary["echo"] / ordinary["coverage"])[dense]
    assert (got - want).abs().max() < 5e-3


@pytest.mark.parametrize("kernel", ["cuda", "auto"])
def test_what_is_prepared_of_weights_is_kept_apart(kernel, random_scene, on_device):
    """A scene that was drawn as absorbing Gaussians before gives the same sums as one that was not."""
    scene, pose = random_scene(50, **WEIGHTS), np.eye(4)[None]
    fresh = sums(kernel, random_scene(50, **WEIGHTS), PROBES["linear"], pose)
    there = on_device(scene) if kernel == "cuda" else scene
    render(there, PROBES["linear"], pose, height=HEIGHT, width=WIDTH, backend="cuda" if kernel == "cuda" else "cpu")
    assert torch.equal(sums(kernel, there, PROBES["linear"], pose).weight, fresh.weight)


def test_an_unknown_backend_is_refused(random_scene):
    with pytest.raises(BackendUnavailable, match="one of reference, cpu, cuda, got 'magic'"):
        weighted_sums(random_scene(3), PROBES["linear"], np.eye(4)[None], HEIGHT, WIDTH, "magic")
