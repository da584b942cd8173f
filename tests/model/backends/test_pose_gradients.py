"""Gradients by poses, of every backend and instruction set: of every output, the true ones."""

from typing import Any

import numpy as np
import pytest
import torch

from ultragray import ConvexProbe, GaussianScene, LinearProbe, PhasedProbe, RadialProbe, SteeredProbe, render
from ultragray.rendering.backends import cpu, cuda
from ultragray.rendering.backends.inputs import scene_poses
from ultragray.rendering.outputs import PLANES

LINEAR = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0)
CONVEX = ConvexProbe(opening_angle_deg=60.0, near_mm=10.0, far_mm=60.0)
HEIGHT, WIDTH = 37, 53
KERNELS = ("cuda", *cpu.INSTRUCTION_SETS)

SCENES = {
    "linear": ({}, LINEAR),
    "convex": ({}, CONVEX),
    "phased": ({"centre_cm": (0, 0, 1.5)}, PhasedProbe(opening_angle_deg=90.0, far_mm=50.0)),
    "radial": ({"centre_cm": (0, 0, 0)}, RadialProbe(near_mm=1.0, far_mm=30.0)),
    "steered": ({}, SteeredProbe(width_mm=40.0, steering_deg=-30.0, near_mm=0.0, far_mm=50.0)),
    "off centre": ({"info": {"centre_mm": (5.0, -3.0, 8.0)}}, LINEAR),
    "shadows": ({"count": 400, "transmittance_logit": (-6, 0), "sigma_cm": (0.1, 0.3)}, LINEAR),
    "needles": ({"sigma_cm": (0.01, 1.0)}, LINEAR),
    "degree 0": ({"sh_degree": 0}, LINEAR),
    "degree 2": ({"sh_degree": 2}, CONVEX),
    "degree 3": ({"sh_degree": 3}, LINEAR),
    "sigmoid": ({"intensity": "sigmoid", "sh_degree": 3}, LINEAR),
}

Draw = Any  # of a scene and poses: outputs by name


def gradient(scene, poses, weights, draw):  # [C, 4, 4]
    """Of the weighted sum of the outputs, by the entries of the poses."""
    leaf = torch.tensor(poses, dtype=torch.float64, requires_grad=True)
    frames = draw(scene, leaf)
    torch.stack([(frames[name] * weight.to(frames[name])).sum() for name, weight in weights.items()]).sum().backward()
    return leaf.grad.numpy()


def by_reference(probe):
    return lambda scene, poses: render(scene, probe, poses, height=HEIGHT, width=WIDTH, backend="reference")


def by_kernel(probe, kernel):
    def draw(scene, poses):
        if kernel == "cuda":
            there = scene.to(cuda.device())
            return cuda.render_outputs(there, probe, scene_poses(there, poses), HEIGHT, WIDTH, PLANES)
        cm = scene_poses(scene, poses)
        return cpu.render_outputs(scene, probe, cm, HEIGHT, WIDTH, PLANES, instruction_set=kernel)

    return draw


@pytest.fixture(scope="session")
def expected(random_scene, random_poses):
    """By scene: what the backends are to be given, and the reference's gradient in float64."""
    done = {}

    def prepare(name):
        if name not in done:
            options, probe = SCENES[name]
            scene, poses = random_scene(**{"seed": 3, "count": 120, **options}), random_poses(3, seed=5)
            poses[:, :3, 3] += scene.info.centre_mm
            with torch.no_grad():
                exact, single = (by_reference(probe)(scene.to(t), poses) for t in (torch.float64, torch.float32))
            generator = torch.Generator().manual_seed(1)
            weights = {}
            for output in PLANES:  # pixels where a threshold flips between float32 and float64 are left out
                stable = (exact[output] - single[output]).abs() < 2e-5
                weights[output] = torch.randn(stable.shape, generator=generator) * stable
            want = gradient(scene.to(torch.float64), poses, weights, by_reference(probe))
            done[name] = (scene, probe, poses, weights, want)
        return done[name]

    return prepare


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("name", SCENES)
def test_poses_of_every_kind(name, kernel, expected):
    scene, probe, poses, weights, want = expected(name)
    got = gradient(scene, poses, weights, by_kernel(probe, kernel))
    for part in (np.s_[:, :3, :3], np.s_[:, :3, 3]):
        error = np.linalg.norm(got[part] - want[part]) / np.linalg.norm(want[part])
        assert error < 1e-3, f"{'rotation' if part == np.s_[:, :3, :3] else 'position'}: relative L2 error {error:.2g}"
    assert not got[:, 3].any()


@pytest.mark.parametrize("probe", [LINEAR, CONVEX, SCENES["steered"][1]], ids=["linear", "convex", "steered"])
def test_moving_the_probe_by_finite_differences(random_scene, random_poses, probe):
    """Six ways to move a rigid body; the reference draws."""
    scene = random_scene(8, seed=2, sigma_cm=(0.3, 0.9), dtype=torch.float64)
    pose = torch.from_numpy(random_poses(1, seed=4)[0])

    def outputs(twist):  # [6] turn in rad, shift in mm
        x, y, z, *shift = twist.unbind()
        zero = torch.zeros_like(x)
        rows = [[zero, -z, y, shift[0]], [z, zero, -x, shift[1]], [-y, x, zero, shift[2]], [zero] * 4]
        moved = torch.linalg.matrix_exp(torch.stack([torch.stack(row) for row in rows])) @ pose
        frames = render(scene, probe, moved, height=5, width=4, backend="reference")
        return tuple(frames[name] for name in PLANES)

    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(outputs, (twist,), eps=1e-6, atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_only_what_moves_a_rotation_comes_back(random_scene, random_poses, backend):
    """A matrix that is no rotation has no frame: RᵀG is antisymmetric."""
    poses = random_poses(2)

    def draw(scene, leaf):
        return render(scene, LINEAR, leaf, height=9, width=7, backend=backend)

    found = gradient(random_scene(50), poses, {"bmode": torch.ones(2, 9, 7)}, draw)
    by_turn = poses[:, :3, :3].transpose(0, 2, 1) @ found[:, :3, :3]
    assert np.abs(by_turn).max() > 1e-3
    np.testing.assert_allclose(by_turn, -by_turn.transpose(0, 2, 1), atol=1e-9)


def test_one_pose_in_float32_gets_its_gradient_in_kind(random_scene):
    pose = torch.eye(4, requires_grad=True)
    render(random_scene(50), LINEAR, pose, height=9, width=7, outputs=("bmode",))["bmode"].sum().backward()
    assert pose.grad.shape == (4, 4)
    assert pose.grad.dtype == torch.float32
    assert pose.grad.any()


def test_poses_and_parameters_together(random_scene, random_poses):
    """Neither gradient depends on the other being asked for."""
    scene, poses = random_scene(80), random_poses(3)
    splats = {name: tensor.requires_grad_() for name, tensor in scene.splats.items()}
    render(scene, LINEAR, poses, height=9, width=7)["bmode"].sum().backward()
    alone = {name: tensor.grad for name, tensor in splats.items()}
    leaf = torch.tensor(poses, requires_grad=True)
    frames = render(scene, LINEAR, leaf, height=9, width=7)
    (by_poses, *together) = torch.autograd.grad(frames["bmode"].sum(), [leaf, *splats.values()])
    for name, found in zip(splats, together, strict=True):
        assert torch.equal(found, alone[name]), name
    still = GaussianScene.from_splats({name: tensor.detach() for name, tensor in splats.items()}, info=scene.info)
    frames = render(still, LINEAR, leaf, height=9, width=7)
    (by_poses_alone,) = torch.autograd.grad(frames["bmode"].sum(), [leaf])
    assert torch.equal(by_poses, by_poses_alone)


def test_the_thread_count_does_not_change_a_bit(random_scene, random_poses):
    scene, poses = random_scene(9000, sigma_cm=(0.02, 0.1)), random_poses(3)
    weights = {"bmode": torch.randn(3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))}
    found = []
    for threads in (1, 3):
        torch.set_num_threads(threads)
        found.append(gradient(scene, poses, weights, by_kernel(LINEAR, "auto")))
    np.testing.assert_array_equal(*found)


def test_no_poses_and_no_gaussians(random_scene):
    none = torch.zeros((0, 4, 4), dtype=torch.float64, requires_grad=True)
    render(random_scene(5), LINEAR, none, height=4, width=4)["bmode"].sum().backward()
    assert none.grad.shape == (0, 4, 4)
    pose = torch.eye(4, dtype=torch.float64, requires_grad=True)
    render(random_scene(0), LINEAR, pose, height=4, width=4)["transmittance"].sum().backward()
    assert not pose.grad.any()


def test_labels_of_poses_that_want_a_gradient(random_scene):
    plain = random_scene(20)
    scene = GaussianScene.from_splats(plain.splats, labels=torch.ones(20, dtype=torch.uint8))
    pose = torch.eye(4, dtype=torch.float64, requires_grad=True)
    labels = render(scene, LINEAR, pose, height=9, width=7, outputs=("labels",))["labels"]
    assert not labels.requires_grad
    assert labels.any()
