"""Adam by its definition, and its moments through a refinement and a checkpoint."""

import torch

from ultragray.learn.training.optimizer import Optimizer

RATES = {"means": 0.1, "sh0": 0.01}


def parameters(seed=0):
    generator = torch.Generator().manual_seed(seed)
    return {
        "means": torch.randn((5, 3), generator=generator).requires_grad_(),
        "sh0": torch.randn((5, 1, 1), generator=generator).requires_grad_(),
        "quats": torch.ones((5, 4)),  # not trained
    }


def set_gradients(tensors, seed):
    generator = torch.Generator().manual_seed(seed)
    for tensor in tensors.values():
        if tensor.requires_grad:
            tensor.grad = torch.randn(tensor.shape, generator=generator)


def test_steps_of_adam_for_a_batch():
    b, given = 4, parameters()
    optimizer = Optimizer(given, batch_size=b)
    first, second = 1 - 0.1 * b, 1 - 0.001 * b
    expected = {name: given[name].detach().double() for name in RATES}
    m = {name: torch.zeros_like(value) for name, value in expected.items()}
    v = {name: torch.zeros_like(value) for name, value in expected.items()}
    for t in (1, 2, 3):
        set_gradients(given, t)
        for name, rate in RATES.items():
            gradient = given[name].grad
            assert gradient is not None
            m[name] = first * m[name] + (1 - first) * gradient
            v[name] = second * v[name] + (1 - second) * gradient**2
            step = (m[name] / (1 - first**t)) / ((v[name] / (1 - second**t)).sqrt() + 1e-15 / b**0.5)
            expected[name] = expected[name] - rate * step
        optimizer.step(RATES)
    for name in RATES:
        assert torch.allclose(given[name].detach().double(), expected[name], atol=1e-5)
        assert given[name].grad is None
    assert bool((given["quats"] == 1).all())


def test_moments_follow_the_gaussians():
    given = parameters()
    optimizer = Optimizer(given, batch_size=4)
    set_gradients(given, 1)
    optimizer.step(RATES)
    before = {name: value.clone() for name, value in optimizer.tensors().items()}
    origin = torch.tensor([4, 1, -1, -1, -1])
    kept = origin[:2]
    grown = {name: torch.cat([value.detach()[kept], torch.zeros_like(value[:3])]) for name, value in given.items()}
    for name in RATES:
        grown[name].requires_grad_()
    optimizer.replace(grown, origin)
    after = optimizer.tensors()
    for name in RATES:
        for moment in ("exp_avg", "exp_avg_sq"):
            assert torch.equal(after[f"{name}.{moment}"][:2], before[f"{name}.{moment}"][kept])
            assert bool((after[f"{name}.{moment}"][2:] == 0).all())
    set_gradients(grown, 2)
    optimizer.step(RATES)
    assert bool((grown["means"].detach()[2:] != 0).all())


def test_goes_on_bit_for_bit_from_its_tensors():
    first = parameters()
    optimizer = Optimizer(first, batch_size=4)
    set_gradients(first, 1)
    optimizer.step(RATES)
    second = {name: value.detach().clone().requires_grad_(value.requires_grad) for name, value in first.items()}
    resumed = Optimizer(second, batch_size=4)
    resumed.load({name: value.clone() for name, value in optimizer.tensors().items()})
    for tensors, one in ((first, optimizer), (second, resumed)):
        set_gradients(tensors, 2)
        one.step(RATES)
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_moments_are_taken_to_the_device_of_the_parameters():
    first = parameters()
    optimizer = Optimizer(first, batch_size=4)
    set_gradients(first, 1)
    optimizer.step(RATES)
    elsewhere = {name: value.detach().to("meta").requires_grad_(value.requires_grad) for name, value in first.items()}
    resumed = Optimizer(elsewhere, batch_size=4)
    resumed.load(optimizer.tensors())
    assert {tensor.device.type for tensor in resumed.tensors().values()} == {"meta"}
    assert resumed.tensors().keys() == optimizer.tensors().keys()
