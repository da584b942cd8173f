"""Displaced tissue: what every backend draws of it, and its gradients, as the reference has them in float64."""

import numpy as np
import pytest
import torch

from ultragray import GaussianScene, LinearProbe, render
from ultragray.errors import BackendUnavailable, InvalidArgument
from ultragray.rendering.backends import cpu
from ultragray.rendering.backends.registry import BACKENDS, Backend, choose_backend
from ultragray.rendering.frames import footprint_pixels
from ultragray.rendering.outputs import PLANES
from ultragray.scene.deformation import Displacement, displaced, spline_coefficients

from .conftest import CONVEX, FOCUSED, LINEAR, STEERED, drawn

ORIGIN_MM, SPACING_MM, GRID = (-45.0, -30.0, -20.0), (18.0, 15.0, 16.0), (6, 5, 7)


@pytest.fixture
def fields(random_poses):
    """Two: one along the axes of the scene, one along those of each of two poses."""
    generator = torch.Generator().manual_seed(5)
    coefficients = 4.0 * torch.randn((1, *GRID, 3), generator=generator)
    samples = 1.5 * torch.randn((2, 4, 5, 6, 3), generator=generator)
    return (
        Displacement.on_grid(coefficients, ORIGIN_MM, SPACING_MM),
        Displacement.through(samples, (-30.0, -20.0, -5.0), 14.0, random_poses(2, seed=5)),
    )


@pytest.mark.parametrize("beam", [None, FOCUSED], ids=["thin", "thick"])
@pytest.mark.parametrize("probe", [LINEAR, CONVEX, STEERED], ids=lambda probe: probe.kind)
def test_gradients_are_those_of_the_reference_in_float64(probe, beam, fields, random_scene, random_poses):
    scene, poses = random_scene(120, seed=3), random_poses(2, seed=5)
    weights = torch.randn((4, 2, 37, 53), generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        exact, single = (
            torch.stack(list(drawn("reference", scene.to(dtype).under(*fields), probe, poses, beam).values()))
            for dtype in (torch.float64, torch.float32)
        )
    weights = weights * ((exact - single).abs() < 2e-5)
    at_rest = drawn("reference", scene, probe, poses, beam)
    assert (exact[0] - at_rest["bmode"]).abs().mean() > 0.01, "the fields move too little to test anything"

    def gradients(kernel, dtype):
        splats = {name: tensor.to(dtype).clone().requires_grad_() for name, tensor in scene.splats.items()}
        leaves = [
            *splats.values(),
            *(one.coefficients.to(dtype).clone().requires_grad_() for one in fields),
            torch.tensor(poses, requires_grad=True),
            *([torch.tensor(beam.numbers, dtype=torch.float64, requires_grad=True)] if beam else []),
        ]
        moved = [Displacement(leaf, one.to_grid) for leaf, one in zip(leaves[6:8], fields, strict=True)]
        copied = GaussianScene.from_splats(splats, info=scene.info).under(*moved)
        planes = drawn(kernel, copied, probe, leaves[8], leaves[9] if beam else None)
        torch.stack(
            [(plane * weight.to(plane)).sum() for plane, weight in zip(planes.values(), weights, strict=True)]
        ).sum().backward()
        names = (*splats, "first", "second", "poses", "beam")
        return {name: leaf.grad.double() for name, leaf in zip(names, leaves, strict=beam is not None)}

    expected = gradients("reference", torch.float64)
    for kernel in cpu.INSTRUCTION_SETS:
        for name, found in gradients(kernel, torch.float32).items():
            error = (found - expected[name]).norm() / expected[name].norm()
            assert error < 1e-3, f"{kernel}: {name} is off by {error:.1e}"


@pytest.mark.parametrize("beam", [None, FOCUSED], ids=["thin", "thick"])
def test_no_gaussian_is_missed_far_from_where_it_was(beam, random_scene, random_poses):
    scene = random_scene(3000, seed=2, extent_cm=(6.0, 6.0, 6.0))
    coefficients = 25.0 * torch.randn((1, 5, 5, 5, 3), generator=torch.Generator().manual_seed(2))
    moved = scene.under(Displacement.on_grid(coefficients, -60.0, 30.0))
    poses = random_poses(2, seed=1)
    expected = drawn("reference", moved.to(torch.float64), LINEAR, poses, beam)
    for kernel in cpu.INSTRUCTION_SETS:
        found = drawn(kernel, moved, LINEAR, poses, beam)
        for name in PLANES:
            assert ((found[name] - expected[name]).abs() < 1e-3).double().mean() > 0.998, f"{kernel}: {name}"


def assert_lit_as(expected, scene, poses, beam, *, tolerance):
    """Every instruction set draws this coverage where it is some."""
    lit = expected > 0.01
    assert lit.sum() > 200
    for kernel in cpu.INSTRUCTION_SETS:
        off = (drawn(kernel, scene, LINEAR, poses, beam)["coverage"] - expected).abs()
        assert (off[lit] < tolerance).double().mean() > 0.995, kernel


@pytest.mark.parametrize("beam", [None, FOCUSED], ids=["thin", "thick"])
def test_no_small_gaussian_is_missed_that_goes_another_way_than_its_cluster(beam, random_scene, random_poses):
    scene = random_scene(3000, seed=2, extent_cm=(6.0, 6.0, 6.0), sigma_cm=(0.02, 0.04))
    coefficients = 25.0 * torch.randn((1, 5, 5, 5, 3), generator=torch.Generator().manual_seed(2))
    moved = scene.under(Displacement.on_grid(coefficients, -60.0, 30.0))
    poses = random_poses(6, seed=1)
    expected = drawn("reference", moved.to(torch.float64), LINEAR, poses, beam)["coverage"]
    assert_lit_as(expected, moved, poses, beam, tolerance=1e-2)


@pytest.mark.parametrize("count", [1, 2], ids=["a field", "two fields"])
@pytest.mark.parametrize("beam", [None, FOCUSED], ids=["thin", "thick"])
def test_tissue_is_drawn_that_fields_bring_to_the_plane_from_out_of_its_reach(beam, count, random_scene):
    centre = np.array([30.0, -20.0, 10.0])
    away = {"centre_cm": (0.0, 2.5, 2.5), "extent_cm": (4.0, 1.0, 5.0), "sigma_cm": (0.02, 0.04)}
    scene = random_scene(3000, seed=4, **away, info={"centre_mm": tuple(centre)})
    samples = torch.randn((1, 4, 5, 6, 3), generator=torch.Generator().manual_seed(4))
    samples[..., 1] -= 25.0
    moved = scene.under(*[Displacement.through(samples / count, centre - (20.0, 20.0, 0.0), 14.0)] * count)
    pose = np.eye(4)[None]
    pose[0, :3, 3] = centre
    for kernel in cpu.INSTRUCTION_SETS:
        assert not drawn(kernel, scene, LINEAR, pose, beam)["coverage"].any(), kernel
    expected = drawn("reference", moved.to(torch.float64), LINEAR, pose, beam)["coverage"]
    assert_lit_as(expected, moved, pose, beam, tolerance=1e-3)


def test_a_field_of_one_value_is_a_probe_that_moved_the_other_way(random_scene, random_poses):
    scene, poses, shift = random_scene(200), random_poses(2), torch.tensor([3.0, -2.0, 4.0])
    shifted = poses.copy()
    shifted[:, :3, 3] -= shift.numpy()
    field = Displacement.through(shift.expand(1, 2, 2, 2, 3), (0, 0, 0), 10.0)
    moved = render(scene.under(field), LINEAR, poses, height=40, width=30)
    expected = render(scene, LINEAR, shifted, height=40, width=30)
    for name in PLANES:
        torch.testing.assert_close(moved[name], expected[name], atol=1e-4, rtol=0)


def test_a_field_goes_through_its_samples_and_its_gradient_is_its_slope():
    generator = torch.Generator().manual_seed(0)
    samples = torch.randn((1, 4, 5, 6, 3), generator=generator, dtype=torch.float64)
    field = Displacement.through(samples, (1.0, 2.0, 3.0), (2.0, 3.0, 4.0))
    nodes = torch.cartesian_prod(*(torch.arange(n, dtype=torch.float64) for n in samples.shape[1:4]))
    points = nodes * torch.tensor([2.0, 3.0, 4.0]) + torch.tensor([1.0, 2.0, 3.0])
    torch.testing.assert_close(field.at(points)[0], samples[0].reshape(-1, 3))
    inner = points.mean(dim=0) + torch.rand((20, 3), generator=generator, dtype=torch.float64)
    _, gradient = field.at(inner)
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[axis] = 1e-5
        slope = (field.at(inner + step)[0] - field.at(inner - step)[0]) / 2e-5
        torch.testing.assert_close(gradient[:, :, axis], slope, atol=1e-7, rtol=0)
    means, whole = displaced(inner, [field, field], 0)
    once, _ = displaced(inner, [field], 0)
    torch.testing.assert_close(means, once + field.at(once)[0])
    assert whole.shape == (20, 3, 3)
    assert spline_coefficients(samples).shape == (1, 6, 7, 8, 3)


def test_a_scene_at_rest_is_drawn_as_before_and_shares_what_was_prepared(random_scene, random_poses, fields):
    scene, poses = random_scene(200), random_poses(2, seed=5)
    before = render(scene, LINEAR, poses, height=20, width=30)
    moved = render(scene.under(*fields), LINEAR, poses, height=20, width=30)
    after = render(scene.under(*fields).under(), LINEAR, poses, height=20, width=30)
    assert scene.under(*fields)._prepared is scene._prepared
    for name in PLANES:
        np.testing.assert_array_equal(before[name].numpy(), after[name].numpy())
        assert not np.array_equal(before[name].numpy(), moved[name].numpy())
    costs = footprint_pixels(scene.under(*fields), LINEAR, poses, height=20, width=30)
    assert costs != footprint_pixels(scene, LINEAR, poses, height=20, width=30)


def test_labels_move_with_their_gaussians(random_scene, random_poses):
    scene = random_scene(300)
    labels = (scene.means[:, 0] > 0).to(torch.uint8) + 1
    labelled = GaussianScene.from_splats(scene.splats, info=scene.info, labels=labels)
    field = Displacement.through(torch.tensor([0.0, 0.0, 5.0]).expand(1, 2, 2, 2, 3), (0, 0, 0), 10.0)
    poses = random_poses(1)
    shifted = poses.copy()
    shifted[:, 2, 3] -= 5.0
    size = {"height": 40, "width": 30, "outputs": ("labels",)}
    moved = render(labelled.under(field), LINEAR, poses, **size).labels
    assert (moved == render(labelled, LINEAR, shifted, **size).labels).float().mean() > 0.995


def test_displacements_that_do_not_fit_are_refused(random_scene, random_poses, fields):
    scene, probe = random_scene(5), LinearProbe(width_mm=20.0, near_mm=0.0, far_mm=20.0)
    with pytest.raises(InvalidArgument, match="one for each of 3 poses, got 2"):
        render(scene.under(*fields), probe, random_poses(3), height=4, width=4)
    with pytest.raises(InvalidArgument, match="at most 4 fields, got 5"):
        scene.under(*fields[:1] * 5)
    with pytest.raises(InvalidArgument, match="each side at least 4"):
        Displacement.on_grid(torch.zeros((1, 3, 4, 4, 3)), 0.0, 1.0)


def test_the_gpu_draws_tissue_at_rest_alone(random_scene, fields, monkeypatch):
    monkeypatch.setitem(BACKENDS, "cuda", Backend(cpu.render_outputs, require=lambda: None))
    with pytest.raises(BackendUnavailable, match="tissue at rest alone"):
        choose_backend("cuda", random_scene(5).under(*fields))
