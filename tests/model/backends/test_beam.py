"""The elevational beam (docs/physics.md §3): its meaning by the reference, the same by every kernel, its gradients."""

import numpy as np
import pytest
import torch

from ultragray import (
    ConvexProbe,
    ElevationBeam,
    GaussianScene,
    LinearProbe,
    PhasedProbe,
    RadialProbe,
    SteeredProbe,
    render,
)
from ultragray.errors import InvalidArgument
from ultragray.rendering.backends import cpu, cuda, reference
from ultragray.rendering.backends.inputs import beam_cm, scene_poses
from ultragray.rendering.frames import footprint_pixels
from ultragray.rendering.limits import UNLIMITED
from ultragray.rendering.outputs import PLANES, WEIGHT_SUM

LINEAR = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0)
HEIGHT, WIDTH = 37, 53
KERNELS = ("cuda", *cpu.INSTRUCTION_SETS)
FOCUSED = ElevationBeam(thickness_mm=2.0, focus_mm=15.0, depth_of_field_mm=12.0)
CONSTANT = ElevationBeam(thickness_mm=3.0)

CASES = {
    "linear": ({}, LINEAR, FOCUSED),
    "linear, constant": ({}, LINEAR, CONSTANT),
    "convex": ({}, ConvexProbe(opening_angle_deg=60.0, near_mm=10.0, far_mm=60.0), FOCUSED),
    "phased": ({"centre_cm": (0, 0, 1.5)}, PhasedProbe(opening_angle_deg=90.0, far_mm=50.0), FOCUSED),
    "radial": ({"centre_cm": (0, 0, 0)}, RadialProbe(near_mm=1.0, far_mm=30.0), FOCUSED),
    "steered": ({}, SteeredProbe(width_mm=40.0, steering_deg=-30.0, near_mm=0.0, far_mm=50.0), FOCUSED),
    "needles": ({"sigma_cm": (0.01, 1.0)}, LINEAR, FOCUSED),
    "shadows": ({"count": 400, "transmittance_logit": (-6, 0), "sigma_cm": (0.1, 0.3)}, LINEAR, FOCUSED),
    "much thicker than the Gaussians": ({"count": 900}, LINEAR, ElevationBeam(thickness_mm=20.0)),
}


def numbers(beam):
    return torch.tensor(beam.numbers, dtype=torch.float64)


def drawn(kernel, scene, probe, poses, beam, outputs=PLANES):
    inside, prepared = scene_poses(scene, poses), beam_cm(beam, probe)
    if kernel == "cuda":
        there = scene.to(cuda.device())
        return cuda.render_outputs(there, probe, inside, HEIGHT, WIDTH, outputs, UNLIMITED, prepared)
    if kernel == "reference":
        return reference.render_outputs(scene, probe, inside, HEIGHT, WIDTH, outputs, UNLIMITED, prepared)
    return cpu.render_outputs(scene, probe, inside, HEIGHT, WIDTH, outputs, UNLIMITED, prepared, instruction_set=kernel)


def shifted_along_elevation(pose, shift_mm):  # [4, 4], [K] -> [K, 4, 4]
    poses = np.repeat(pose[None], len(shift_mm), axis=0)
    poses[:, :3, 3] += shift_mm[:, None] * pose[:3, 1]
    return poses


def weight_sums(scene, poses, beam):  # [C, H, W]
    return drawn("reference", scene, LINEAR, poses, beam, (WEIGHT_SUM,))[WEIGHT_SUM]


def test_a_constant_beam_is_the_mean_of_thin_slices(random_scene, random_poses):
    scene = random_scene(4, seed=1, sigma_cm=(0.2, 0.6), dtype=torch.float64)
    (pose,) = random_poses(1, seed=2)
    nodes, weights = np.polynomial.hermite_e.hermegauss(31)
    sigma_mm = CONSTANT.thickness_mm / 2.3548
    slices = weight_sums(scene, shifted_along_elevation(pose, nodes * sigma_mm), None)
    mean = torch.einsum("k,khw->hw", torch.from_numpy(weights / weights.sum()), slices)
    thick = weight_sums(scene, pose[None], CONSTANT)[0]
    assert thick.max() > 0.2
    assert (thick - mean).abs().max() < 4 / 255  # of each Gaussian, weights below 1/255 may be left out


def test_a_beam_conserves_the_weight_that_lies_across_elevation(random_scene):
    scene = random_scene(4, seed=1, sigma_cm=(0.1, 0.3), dtype=torch.float64)
    across = np.linspace(-25.0, 25.0, 101)
    poses = shifted_along_elevation(np.eye(4), across)
    thin, thick = (weight_sums(scene, poses, beam).sum() for beam in (None, ElevationBeam(thickness_mm=4.0)))
    assert thick == pytest.approx(float(thin), rel=0.1)


def test_a_thickness_grows_by_the_square_root_of_two_within_half_the_depth_of_field():
    for offset in (-6.0, 6.0):
        assert FOCUSED.thickness_at_mm(15.0 + offset) == pytest.approx(2.0 * np.sqrt(2.0))
    assert CONSTANT.thickness_at_mm(40.0) == 3.0


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("name", CASES)
def test_frames_match_the_reference_in_float64(name, kernel, random_scene, random_poses):
    options, probe, beam = CASES[name]
    scene, poses = random_scene(**{"seed": 3, "count": 200, **options}), random_poses(2, seed=5)
    exact = drawn("reference", scene.to(torch.float64), probe, poses, beam)
    got = drawn(kernel, scene, probe, poses, beam)
    for output in PLANES:
        errors = (got[output].cpu().double() - exact[output]).abs()
        assert errors.quantile(0.999) < 5e-4, output
        assert errors.max() < 6e-3, output  # where a threshold flips between float32 and float64


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("name", CASES)
def test_gradients_of_parameters_poses_and_beam_are_the_true_ones(name, kernel, random_scene, random_poses):
    options, probe, beam = CASES[name]
    scene, poses = random_scene(**{"seed": 3, "count": 120, **options}), random_poses(2, seed=5)
    with torch.no_grad():
        exact, single = (
            drawn("reference", scene.to(dtype), probe, poses, beam) for dtype in (torch.float64, torch.float32)
        )
    generator = torch.Generator().manual_seed(1)
    weights = {
        output: torch.randn(exact[output].shape, generator=generator) * ((exact[output] - single[output]).abs() < 2e-5)
        for output in PLANES
    }

    def gradients(kernel, scene):
        leaves = {raw: tensor.clone().requires_grad_() for raw, tensor in scene.splats.items()}
        of_beam, of_poses = numbers(beam).requires_grad_(), torch.from_numpy(poses).requires_grad_()
        frames = drawn(kernel, GaussianScene.from_splats(leaves, info=scene.info), probe, of_poses, of_beam)
        torch.stack(
            [(frames[name] * weight.to(frames[name])).sum() for name, weight in weights.items()]
        ).sum().backward()
        thickness, focus, depth_of_field = of_beam.grad
        return {
            **{raw: leaf.grad.double() for raw, leaf in leaves.items()},
            "poses": of_poses.grad,
            "thickness": thickness,
            "focus": focus,
            "depth_of_field": depth_of_field,
        }

    want, got = gradients("reference", scene.to(torch.float64)), gradients(kernel, scene)
    for of, true in want.items():
        error = float((got[of] - true).norm() / true.norm().clamp(min=1e-6))
        assert error < 1e-3, f"{of}: relative error {error:.2g}"


def test_the_reference_by_finite_differences(random_scene, random_poses):
    scene = random_scene(8, seed=2, sigma_cm=(0.3, 0.9), dtype=torch.float64)
    pose = random_poses(1, seed=4)

    def frames(beam, *splats):
        moved = GaussianScene.from_splats(dict(zip(scene.splats, splats, strict=True)), info=scene.info)
        found = render(moved, LINEAR, pose, height=5, width=4, backend="reference", beam=beam)
        return tuple(found[name] for name in PLANES)

    leaves = tuple(tensor.clone().requires_grad_() for tensor in (numbers(FOCUSED), *scene.splats.values()))
    assert torch.autograd.gradcheck(frames, leaves, eps=1e-7, atol=1e-6, rtol=1e-4)


def test_the_gradient_of_the_beam_alone(random_scene):
    scene = random_scene(100)
    found = []
    for backend in ("reference", "cpu"):
        beam = numbers(FOCUSED).requires_grad_()
        render(scene, LINEAR, np.eye(4), height=32, width=32, backend=backend, beam=beam).echo.sum().backward()
        found.append(beam.grad)
    assert torch.allclose(*found, rtol=1e-3)


def test_the_beam_of_the_scene_holds_unless_another_is_asked_for(random_scene):
    scene, thick = random_scene(100), random_scene(100, info={"beam": CONSTANT})

    def frame(scene, beam=None):
        return render(scene, LINEAR, np.eye(4), height=32, width=32, beam=beam).bmode

    assert torch.equal(frame(thick), frame(scene, CONSTANT))
    assert not torch.equal(frame(thick), frame(scene))
    assert torch.equal(frame(thick, ElevationBeam(thickness_mm=0.0)), frame(scene))


def test_a_thick_slice_cuts_more_gaussians_and_costs_more(random_scene):
    scene = random_scene(2000, sigma_cm=(0.02, 0.05))
    thin, thick = (
        footprint_pixels(scene, LINEAR, np.eye(4), height=64, width=64, beam=beam)[0] for beam in (None, CONSTANT)
    )
    assert thick > 2 * thin


@pytest.mark.parametrize(
    ("given", "missing"), [({"focus_mm": 10.0}, "depth_of_field_mm"), ({"depth_of_field_mm": 10.0}, "focus_mm")]
)
def test_a_focus_needs_a_depth_of_field(given, missing):
    with pytest.raises(InvalidArgument, match=f"{missing} must be given"):
        ElevationBeam(thickness_mm=1.0, **given)


def test_a_beam_of_another_shape_is_refused(random_scene):
    with pytest.raises(InvalidArgument, match=r"an ElevationBeam or a tensor \[3\]"):
        render(random_scene(2), LINEAR, np.eye(4), height=8, width=8, beam=torch.ones(2))
