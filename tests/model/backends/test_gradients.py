"""One suite of gradients for every backend and instruction set: of every output, by every parameter, the true one."""

import numpy as np
import pytest
import torch

from ultragray import ConvexProbe, GaussianScene, LinearProbe, PhasedProbe, RadialProbe, SteeredProbe, render
from ultragray.rendering.backends import cpu, cuda
from ultragray.rendering.outputs import PLANES

LINEAR = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0)
CONVEX = ConvexProbe(opening_angle_deg=60.0, near_mm=10.0, far_mm=60.0)
HEIGHT, WIDTH = 37, 53
KERNELS = ("cuda", *cpu.INSTRUCTION_SETS)

SCENES = {
    "linear": ({}, LINEAR),
    "convex": ({}, CONVEX),
    "phased": ({"centre_cm": (0, 0, 1.5)}, PhasedProbe(opening_angle_deg=90.0, far_mm=50.0)),
    "wide fan": ({}, ConvexProbe(opening_angle_deg=150.0, near_mm=5.0, far_mm=50.0)),
    "radial": ({"centre_cm": (0, 0, 0)}, RadialProbe(near_mm=1.0, far_mm=30.0)),
    "radial about the centre": (
        {"centre_cm": (0, 0, 0), "extent_cm": (1, 1, 1), "sigma_cm": (0.05, 0.4)},
        RadialProbe(near_mm=0.0, far_mm=20.0),
    ),
    "steered": ({}, SteeredProbe(width_mm=40.0, steering_deg=-30.0, near_mm=0.0, far_mm=50.0)),
    "one Gaussian": ({"count": 1, "extent_cm": (0.1, 0.01, 0.1), "sigma_cm": (0.2, 0.3)}, LINEAR),
    "shadows": ({"count": 400, "transmittance_logit": (-6, 0), "sigma_cm": (0.1, 0.3)}, LINEAR),
    "shadows in a fan": ({"count": 400, "transmittance_logit": (-6, 0), "sigma_cm": (0.1, 0.3)}, CONVEX),
    "saturated": ({"count": 40, "sigma_cm": (1.0, 3.0), "transmittance_logit": (2.0, 5.0)}, LINEAR),
    "at the face": ({"centre_cm": (0, 0, 0.02), "extent_cm": (3, 0.2, 0.3), "sigma_cm": (0.02, 0.3)}, LINEAR),
    "needles": ({"sigma_cm": (0.01, 1.0)}, LINEAR),
    "transparent": ({"transmittance_logit": (10.0, 16.0)}, CONVEX),
    "degree 0": ({"sh_degree": 0}, LINEAR),
    "degree 2": ({"sh_degree": 2}, CONVEX),
    "degree 3": ({"sh_degree": 3}, LINEAR),
    "sigmoid": ({"intensity": "sigmoid", "sh_degree": 3}, LINEAR),
}


def gradients(scene, weights, draw):
    """Of the weighted sum of the outputs, by raw parameter."""
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in scene.splats.items()}
    frames = draw(GaussianScene.from_splats(leaves, info=scene.info))
    loss = torch.stack([(frames[name] * weight.to(frames[name])).sum() for name, weight in weights.items()]).sum()
    loss.backward()
    return {
        name: np.zeros(tuple(leaf.shape)) if leaf.grad is None else leaf.grad.cpu().double().numpy()
        for name, leaf in leaves.items()
    }


def by_reference(probe, poses):
    return lambda scene: render(scene, probe, poses, height=HEIGHT, width=WIDTH, backend="reference")


def by_kernel(probe, poses, kernel, height=HEIGHT, width=WIDTH):
    """The CUDA backend, which takes the scene's tensors to its device, or an instruction set of the CPU's."""
    if kernel == "cuda":

        def draw(scene):
            there = scene.to(cuda.device())
            return cuda.render_outputs(there, probe, there.poses_to_scene_cm(poses), height, width, PLANES)

        return draw
    return lambda scene: cpu.render_outputs(
        scene, probe, scene.poses_to_scene_cm(poses), height, width, PLANES, instruction_set=kernel
    )


@pytest.fixture(scope="session")
def expected(random_scene, random_poses):
    """By scene and outputs: what the backends are to be given, and the reference's gradient in float64."""
    done = {}

    def prepare(name, outputs):
        if (name, outputs) not in done:
            options, probe = SCENES[name]
            scene, poses = random_scene(**{"seed": 3, "count": 120, **options}), random_poses(3, seed=5)
            with torch.no_grad():
                exact, single = (by_reference(probe, poses)(scene.to(t)) for t in (torch.float64, torch.float32))
            generator = torch.Generator().manual_seed(1)
            weights = {}
            for output in outputs:  # pixels where a threshold flips between float32 and float64 are left out
                stable = (exact[output] - single[output]).abs() < 2e-5
                weights[output] = torch.randn(stable.shape, generator=generator) * stable
            want = gradients(scene.to(torch.float64), weights, by_reference(probe, poses))
            done[name, outputs] = (scene, probe, poses, weights, want)
        return done[name, outputs]

    return prepare


def assert_same_direction_and_length(got, want):
    assert got.keys() == want.keys()
    for name, exact in want.items():
        size = np.linalg.norm(exact)
        if exact.size and size > 1e-6:
            error = np.linalg.norm(got[name] - exact) / size
            assert error < 1e-3, f"{name}: relative L2 error {error:.2g}"
        else:
            assert np.abs(got[name]).max(initial=0.0) < 1e-6


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("name", SCENES)
def test_all_outputs_together(name, kernel, expected):
    scene, probe, poses, weights, want = expected(name, PLANES)
    assert_same_direction_and_length(gradients(scene, weights, by_kernel(probe, poses, kernel)), want)


@pytest.mark.parametrize("kernel", ["cuda", "auto"])
@pytest.mark.parametrize("output", PLANES)
@pytest.mark.parametrize("name", ["linear", "convex", "shadows"])
def test_each_output_alone(name, output, kernel, expected):
    scene, probe, poses, weights, want = expected(name, (output,))
    assert_same_direction_and_length(gradients(scene, weights, by_kernel(probe, poses, kernel)), want)


@pytest.mark.parametrize("kernel", KERNELS)
def test_golden_gradient(golden, kernel):
    file = golden("g05")
    scene = file.scene(torch.float32)
    draw = by_kernel(file.probe, file.poses, kernel, file.height, file.width)
    got = gradients(scene, {"bmode": torch.from_numpy(file.arrays["G"])}, draw)
    for name, gradient in got.items():
        want = file.arrays[f"true_grad_{name}"]
        error = np.linalg.norm(gradient - want) / np.linalg.norm(want)
        assert error < 1e-4, f"{name}: relative L2 error {error:.2g}"


@pytest.mark.parametrize("probe", [LINEAR, CONVEX], ids=["linear", "convex"])
def test_the_reference_by_finite_differences(random_scene, random_poses, probe):
    scene = random_scene(8, seed=2, sigma_cm=(0.3, 0.9), dtype=torch.float64)
    pose = random_poses(1, seed=4)

    def outputs(*splats):
        moved = GaussianScene.from_splats(dict(zip(scene.splats, splats, strict=True)), info=scene.info)
        frames = render(moved, probe, pose, height=5, width=4, backend="reference")
        return tuple(frames[name] for name in PLANES)

    leaves = tuple(tensor.clone().requires_grad_() for tensor in scene.splats.values())
    assert torch.autograd.gradcheck(outputs, leaves, eps=1e-7, atol=1e-6, rtol=1e-4)


def test_the_thread_count_does_not_change_a_bit(random_scene, random_poses):
    scene, poses = random_scene(9000, sigma_cm=(0.02, 0.1)), random_poses(3)
    weights = {"bmode": torch.randn(3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))}
    before = torch.get_num_threads()
    try:
        found = []
        for threads in (1, 3):
            torch.set_num_threads(threads)
            found.append(gradients(scene, weights, by_kernel(LINEAR, poses, "auto")))
    finally:
        torch.set_num_threads(before)
    for name, gradient in found[0].items():
        assert np.array_equal(gradient, found[1][name]), name


def test_strided_parameters_and_gradients(random_scene, random_poses):
    scene, poses = random_scene(50), random_poses(2)
    weights = {"bmode": torch.ones(1).expand(2, HEIGHT, WIDTH)}
    packed = gradients(scene, weights, by_kernel(LINEAR, poses, "auto"))
    means = scene.means.t().contiguous().t().requires_grad_()
    strided = GaussianScene.from_splats({**scene.splats, "means": means}, info=scene.info)
    by_kernel(LINEAR, poses, "auto")(strided)["bmode"].sum().backward()
    assert np.array_equal(means.grad.double().numpy(), packed["means"])


def test_no_poses_give_zero_gradients(random_scene):
    scene = random_scene(5)
    for tensor in scene.splats.values():
        tensor.requires_grad_()
    render(scene, LINEAR, np.zeros((0, 4, 4)), height=4, width=4).bmode.sum().backward()
    assert all(tensor.grad is not None and not tensor.grad.any() for tensor in scene.splats.values())


def test_the_graph_may_be_used_twice(random_scene):
    scene = random_scene(30)
    scene.sh0.requires_grad_()
    bmode = render(scene, LINEAR, np.eye(4), height=8, width=8).bmode
    (first,) = torch.autograd.grad(bmode.sum(), scene.sh0, retain_graph=True)
    (second,) = torch.autograd.grad(bmode.sum(), scene.sh0)
    assert first.any()
    assert torch.equal(first, second)
