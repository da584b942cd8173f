"""sh0 for an intensity, and the way back from the ends of the activation."""

import pytest
import torch

from ultragray import GaussianScene, SceneInfo
from ultragray.learn.training.intensity import project_sh0, sh0_of_intensity
from ultragray.rendering.backends import reference
from ultragray.scene.info import expected_shapes


def intensity_of(sh0, name):
    splats = {key: torch.ones(shape) for key, shape in expected_shapes(len(sh0), 0).items()}
    scene = GaussianScene.from_splats({**splats, "sh0": sh0.reshape(-1, 1, 1)}, info=SceneInfo(intensity=name))
    return reference.intensity(scene, torch.zeros(3))


@pytest.mark.parametrize(("name", "low", "high"), [("released", 0.501, 0.998), ("sigmoid", 0.02, 0.98)])
def test_gives_the_intensity(name, low, high):
    wanted = torch.linspace(0.0, 1.0, 11)
    assert torch.allclose(intensity_of(sh0_of_intensity(wanted, name), name), wanted.clamp(low, high), atol=1e-6)


def test_released_gaussian_beyond_an_end_has_a_gradient_again():
    sh0 = torch.tensor([-5.0, 5.0]).reshape(2, 1, 1)
    project_sh0(sh0, "released", None)
    sh0.requires_grad_()
    intensity_of(sh0, "released").sum().backward()
    assert sh0.grad is not None
    assert bool((sh0.grad > 0.28).all())


def test_sigmoid_is_left_alone():
    sh0 = torch.tensor([-50.0, 50.0]).reshape(2, 1, 1)
    project_sh0(sh0, "sigmoid", torch.zeros(2))
    assert sh0.flatten().tolist() == [-50.0, 50.0]


@pytest.mark.parametrize("name", ["released", "sigmoid"])
def test_a_floor_is_the_least_intensity(name):
    sh0 = torch.tensor([-5.0, 0.5, -0.4]).reshape(3, 1, 1)
    free = sh0.clone()
    project_sh0(free, name, None)
    project_sh0(sh0, name, torch.tensor([0.6, 0.6, 0.0]))
    assert intensity_of(sh0, name)[0].item() == pytest.approx(0.6)
    assert torch.equal(sh0[1:], free[1:])
