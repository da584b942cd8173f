"""One suite of gradients for every backend and instruction set: by parameters, poses and beam, the true ones."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ultragray import GaussianScene, render
from ultragray.rendering.outputs import PLANES

from .conftest import CASES, CONVEX, FOCUSED, HEIGHT, KERNELS, LINEAR, STEERED, WIDTH, Case, drawn

OWN = {
    "off centre": Case({"info": {"centre_mm": (5.0, -3.0, 8.0)}}),
    "one Gaussian": Case({"count": 1, "extent_cm": (0.1, 0.01, 0.1), "sigma_cm": (0.2, 0.3)}),
    "shadows in a fan": Case({"count": 400, "transmittance_logit": (-6, 0), "sigma_cm": (0.1, 0.3)}, CONVEX),
    "saturated": Case({"count": 40, "sigma_cm": (1.0, 3.0), "transmittance_logit": (2.0, 5.0)}),
    "transparent": Case({"transmittance_logit": (10.0, 16.0)}, CONVEX),
}
SHARED = (
    *(
        "linear",
        "convex",
        "phased",
        "wide_fan",
        "radial",
        "radial_about_the_centre",
        "steered",
        "at_the_face",
        "needles",
    ),
    *("dense_and_absorbing", "degree_0", "degree_2", "degree_3", "sigmoid_degree_3", "linear, constant"),
    *("convex, focused", "phased, focused", "radial, focused", "steered, focused", "needles, focused"),
    "much thicker than the Gaussians",
)
MOST_GAUSSIANS = 400


def gradients(kernel, scene, probe, poses, beam, weights):
    """Of the weighted sum of the outputs: by raw parameter, turn and place of the poses, and numbers of the beam."""
    splats = {name: tensor.clone().requires_grad_() for name, tensor in scene.splats.items()}
    leaves = {**splats, "poses": torch.tensor(poses, dtype=torch.float64, requires_grad=True)}
    if beam is not None:
        leaves["beam"] = torch.tensor(beam.numbers, dtype=torch.float64, requires_grad=True)
    copied = GaussianScene.from_splats(splats, info=scene.info)
    planes = drawn(kernel, copied, probe, leaves["poses"], leaves.get("beam"), outputs=tuple(weights))
    torch.stack([(planes[name] * weight.to(planes[name])).sum() for name, weight in weights.items()]).sum().backward()
    found = {name: np.zeros(leaf.shape) if leaf.grad is None else leaf.grad.numpy() for name, leaf in leaves.items()}
    by_poses = found.pop("poses")
    assert not by_poses[:, 3].any()
    return {**found, "turns": by_poses[:, :3, :3], "places": by_poses[:, :3, 3]}


@pytest.fixture(scope="session")
def expected(random_scene, random_poses):
    """By case and outputs: what the backends are to be given, and the reference's gradient in float64."""
    done = {}

    def prepare(name, outputs=PLANES):
        if (name, outputs) not in done:
            case = OWN.get(name) or CASES[name]
            probe, beam, count = case.probe, case.beam, min(case.scene.get("count", 120), MOST_GAUSSIANS)
            scene, poses = random_scene(**{"seed": 3, **case.scene, "count": count}), random_poses(2, seed=5)
            poses[:, :3, 3] += scene.info.centre_mm
            with torch.no_grad():
                exact, single = (
                    drawn("reference", scene.to(dtype), probe, poses, beam, outputs=outputs)
                    for dtype in (torch.float64, torch.float32)
                )
            generator, weights = torch.Generator().manual_seed(1), {}
            for output in outputs:  # pixels where a threshold flips between float32 and float64 are left out
                stable = (exact[output] - single[output]).abs() < 2e-5
                weights[output] = torch.randn(stable.shape, generator=generator) * stable
            view = (probe, poses, beam, weights)
            done[name, outputs] = scene, view, gradients("reference", scene.to(torch.float64), *view)
        return done[name, outputs]

    return prepare


def assert_are_those(got, want, tolerance=1e-3):
    assert got.keys() == want.keys()
    for name, exact in want.items():
        size = np.linalg.norm(exact)
        if exact.size and size > 1e-6:
            error = np.linalg.norm(got[name] - exact) / size
            assert error < tolerance, f"{name}: relative L2 error {error:.2g}"
        else:
            assert np.abs(got[name]).max(initial=0.0) < 1e-6


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("name", [*SHARED, *OWN])
def test_gradients_are_those_of_the_reference_in_float64(name, kernel, expected):
    scene, view, want = expected(name)
    assert_are_those(gradients(kernel, scene, *view), want)


@pytest.mark.parametrize("kernel", ["cuda", "auto"])
@pytest.mark.parametrize("output", PLANES)
def test_each_output_alone(output, kernel, expected):
    scene, view, want = expected("convex", (output,))
    assert_are_those(gradients(kernel, scene, *view), want)


@pytest.mark.parametrize("kernel", [pytest.param("reference", marks=pytest.mark.long), *KERNELS])
def test_golden_gradient(golden, kernel):
    file = golden("g05")
    is_exact = kernel == "reference"
    leaves = file.scene(torch.float64 if is_exact else torch.float32).splats
    scene = GaussianScene.from_splats({name: tensor.requires_grad_() for name, tensor in leaves.items()})
    size = (file.height, file.width)
    bmode = drawn(kernel, scene, file.probe, file.poses, size=size, outputs=("bmode",))["bmode"]
    loss = (bmode * torch.from_numpy(file.arrays["G"]).to(bmode)).sum()
    assert loss.item() == pytest.approx(float(file.arrays["loss"]), rel=1e-4)
    loss.backward()
    got = {name: tensor.grad.numpy() for name, tensor in leaves.items()}
    assert_are_those(got, {name: file.arrays[f"true_grad_{name}"] for name in got}, 1e-5 if is_exact else 1e-4)


@pytest.mark.parametrize(
    ("probe", "intensity"), [(LINEAR, "released"), (CONVEX, "sigmoid"), (STEERED, "released")], ids=str
)
def test_the_reference_by_finite_differences(random_scene, random_poses, probe, intensity):
    """By six ways to move a rigid body, the beam and all parameters."""
    scene = random_scene(2, seed=5, sigma_cm=(0.3, 0.9), intensity=intensity, dtype=torch.float64)
    scene.sh0.fill_(-0.4)  # away from the clamps of `released`, where it has no derivative
    pose = torch.from_numpy(random_poses(1, seed=4)[0])

    def outputs(twist, beam, *splats):  # [6] turn in rad, shift in mm; [3]
        x, y, z, *shift = twist.unbind()
        zero = torch.zeros_like(x)
        rows = [[zero, -z, y, shift[0]], [z, zero, -x, shift[1]], [-y, x, zero, shift[2]], [zero] * 4]
        moved = torch.linalg.matrix_exp(torch.stack([torch.stack(row) for row in rows])) @ pose
        other = GaussianScene.from_splats(dict(zip(scene.splats, splats, strict=True)), info=scene.info)
        frames = render(other, probe, moved, height=4, width=3, backend="reference", beam=beam)
        return tuple(frames[name] for name in PLANES)

    leaves = torch.zeros(6, dtype=torch.float64), torch.tensor(FOCUSED.numbers, dtype=torch.float64)
    inputs = tuple(tensor.clone().requires_grad_() for tensor in (*leaves, *scene.splats.values()))
    assert torch.autograd.gradcheck(outputs, inputs, eps=1e-7, atol=1e-6, rtol=1e-4)


def test_the_thread_count_does_not_change_a_bit(random_scene, random_poses):
    scene, poses = random_scene(9000, sigma_cm=(0.02, 0.1)), random_poses(3)
    weights = {"bmode": torch.randn(3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))}
    found = []
    for threads in (1, 3):
        torch.set_num_threads(threads)
        found.append(gradients("auto", scene, LINEAR, poses, None, weights))
    for name, gradient in found[0].items():
        assert np.array_equal(gradient, found[1][name]), name


def test_strided_parameters_and_gradients(random_scene, random_poses):
    scene, poses = random_scene(50), random_poses(2)
    packed = gradients("auto", scene, LINEAR, poses, None, {"bmode": torch.ones(1).expand(2, HEIGHT, WIDTH)})
    means = scene.means.t().contiguous().t().requires_grad_()
    strided = GaussianScene.from_splats({**scene.splats, "means": means}, info=scene.info)
    drawn("auto", strided, LINEAR, poses)["bmode"].sum().backward()
    assert np.array_equal(means.grad.numpy(), packed["means"])


def test_no_poses_and_no_gaussians(random_scene):
    scene, none = random_scene(5), torch.zeros((0, 4, 4), dtype=torch.float64, requires_grad=True)
    for tensor in scene.splats.values():
        tensor.requires_grad_()
    render(scene, LINEAR, none, height=4, width=4)["bmode"].sum().backward()
    assert none.grad.shape == (0, 4, 4)
    assert all(tensor.grad is not None and not tensor.grad.any() for tensor in scene.splats.values())
    pose = torch.eye(4, dtype=torch.float64, requires_grad=True)
    nothing = replace(scene, **{name: tensor[:0] for name, tensor in scene.splats.items()})
    render(nothing, LINEAR, pose, height=4, width=4)["transmittance"].sum().backward()
    assert not pose.grad.any()


def test_the_graph_may_be_used_twice(random_scene):
    scene = random_scene(30)
    scene.sh0.requires_grad_()
    bmode = render(scene, LINEAR, np.eye(4), height=8, width=8).bmode
    (first,) = torch.autograd.grad(bmode.sum(), scene.sh0, retain_graph=True)
    (second,) = torch.autograd.grad(bmode.sum(), scene.sh0)
    assert first.any()
    assert torch.equal(first, second)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_only_what_moves_a_rotation_comes_back(random_scene, random_poses, backend):
    """A matrix that is no rotation has no frame: RᵀG is antisymmetric."""
    poses = random_poses(2)
    leaf = torch.tensor(poses, requires_grad=True)
    render(random_scene(50), LINEAR, leaf, height=9, width=7, backend=backend)["bmode"].sum().backward()
    by_turn = poses[:, :3, :3].transpose(0, 2, 1) @ leaf.grad.numpy()[:, :3, :3]
    assert np.abs(by_turn).max() > 1e-3
    np.testing.assert_allclose(by_turn, -by_turn.transpose(0, 2, 1), atol=1e-9)


def test_one_pose_in_float32_gets_its_gradient_in_kind_and_labels_none(random_scene):
    scene = GaussianScene.from_splats(random_scene(50).splats, labels=torch.ones(50, dtype=torch.uint8))
    pose = torch.eye(4, requires_grad=True)
    frames = render(scene, LINEAR, pose, height=9, width=7, outputs=("bmode", "labels"))
    assert frames["labels"].any()
    assert not frames["labels"].requires_grad
    frames["bmode"].sum().backward()
    assert (pose.grad.shape, pose.grad.dtype) == ((4, 4), torch.float32)
    assert pose.grad.any()


def test_no_gradient_depends_on_another_being_asked_for(random_scene, random_poses):
    scene, poses, beam = random_scene(80), random_poses(3), torch.tensor(FOCUSED.numbers, dtype=torch.float64)
    leaves = [torch.tensor(poses), beam, *scene.splats.values()]

    def found(*wanted):
        for place, leaf in enumerate(leaves):
            leaf.requires_grad_(place in wanted)
        bmode = render(scene, LINEAR, leaves[0], height=9, width=7, beam=beam)["bmode"]
        return torch.autograd.grad(bmode.sum(), [leaves[place] for place in wanted])

    together = found(*range(len(leaves)))
    for alone in ((0,), (1,), tuple(range(2, len(leaves)))):
        for place, gradient in zip(alone, found(*alone), strict=True):
            assert torch.equal(gradient, together[place]), place
