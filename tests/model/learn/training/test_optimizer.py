"""Adam by its definition, what is refined and when; moments through a refinement and a checkpoint."""

import math

import pytest
import torch

from ultragray import _cpu
from ultragray.learn.training import TrainingConfig
from ultragray.learn.training.optimizer import MOMENTS, STEP, Optimizer, PullStatistics, Schedule, refine, rotate
from ultragray.rendering.backends import cpu

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


def test_the_kernel_updates_as_torch_does_and_adds_the_penalty_of_the_scales():
    generator, count = torch.Generator().manual_seed(1), 40_007  # no multiple of a vector, and more than one stretch
    first = {name: torch.randn((count, 3), generator=generator).requires_grad_() for name in ("means", "scales")}
    second = {name: value.detach().clone().requires_grad_() for name, value in first.items()}
    by_kernel, by_torch = (Optimizer(one, batch_size=4, scale_penalty=0.7) for one in (first, second))
    rates = {"means": 0.1, "scales": 0.02}
    for t in (1, 2, 3):
        set_gradients(first, t), set_gradients(second, t)
        expected = 0.7 * float(first["scales"].detach().double().exp().mean())
        assert by_kernel.step(rates) == pytest.approx(expected, rel=1e-5)
        for name in second:
            by_torch._state.setdefault(name, {moment: torch.zeros(count, 3) for moment in MOMENTS})
            by_torch._state[name][STEP] = torch.tensor(float(t))
        assert float(by_torch._step_by_torch(second, rates)) == pytest.approx(expected, rel=1e-5)
        for name, value in first.items():
            assert torch.allclose(value.detach(), second[name].detach(), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("instruction_set", cpu.INSTRUCTION_SETS)
def test_the_thread_count_does_not_change_an_update(instruction_set):
    found = []
    for threads in (1, 3):
        values, gradient, *moments = torch.randn((4, 50_001), generator=torch.Generator().manual_seed(0)).abs().numpy()
        penalty = _cpu.adam(
            values=[values],
            gradients=[gradient],
            first=[moments[0]],
            second=[moments[1]],
            steps=[3],
            rates=[0.1],
            penalties=[1.0],
            beta1=0.6,
            beta2=0.99,
            eps=1e-15,
            threads=threads,
            instruction_set=instruction_set,
        )
        found.append((penalty, values.tobytes(), moments[0].tobytes(), moments[1].tobytes()))
    assert found[0] == found[1]


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


SCENE_SCALE_CM = 10.0


def splats(sizes_cm):
    count = len(sizes_cm)
    scales = torch.log(torch.tensor(sizes_cm)[:, None].repeat(1, 3))
    scales[:, 1:] -= 1.0  # the largest decides
    return {
        "means": torch.arange(count * 3, dtype=torch.float32).reshape(count, 3),
        "scales": scales,
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        "transmittances": torch.arange(count, dtype=torch.float32),
        "sh0": torch.full((count, 1, 1), -0.5),
        "shN": torch.zeros((count, 3, 1)),
    }


def refined(sizes_cm, pull, limit, **settings):
    config = TrainingConfig.preset("paper", **settings)
    return refine(
        splats(sizes_cm),
        torch.tensor(pull),
        limit=limit,
        scene_scale_cm=SCENE_SCALE_CM,
        config=config,
        generator=torch.Generator().manual_seed(0),
    )


def by_parent(parameters):
    """The rows in the order of the Gaussians that they come from, which `splats` numbers by their transmittance."""
    order = torch.argsort(parameters["transmittances"], stable=True)
    return {name: tensor[order] for name, tensor in parameters.items()}


def test_pulled_gaussians_are_duplicated_or_split_by_their_size():
    found, origin, parent = refined([0.05, 0.05, 0.5, 0.5], [0.0, 1e-4, 0.0, 1e-4], limit=100)
    assert sorted(parent.tolist()) == [0, 1, 1, 2, 3, 3]
    assert torch.equal(parent[origin >= 0], origin[origin >= 0])
    assert sorted(origin.tolist()) == [-1, -1, -1, 0, 1, 2]
    found = by_parent(found)
    assert found["transmittances"].tolist() == [
        0.0,
        1.0,
        1.0,
        2.0,
        3.0,
        3.0,
    ]  # the duplicate beside its like, two halves
    assert torch.equal(found["means"][1], found["means"][2])
    halves = slice(4, 6)
    assert torch.allclose(found["scales"][halves, 0], torch.tensor(math.log(0.5 / 1.6)))
    assert torch.allclose(found["sh0"][halves], torch.tensor(-1.5))
    assert torch.allclose(found["sh0"][:4], torch.tensor(-0.5))
    offsets = found["means"][halves] - splats([0.5] * 4)["means"][3]
    assert bool((offsets != 0).all())
    assert not torch.equal(offsets[0], offsets[1])


def test_halves_are_drawn_from_the_gaussian():
    count = 2000
    found, origin, _ = refined([0.5] * count, [1.0] * count, limit=2 * count)
    assert bool((origin == -1).all())
    offsets = by_parent(found)["means"] - splats([0.5] * count)["means"].repeat_interleave(2, dim=0)
    expected = torch.tensor([0.5, 0.5 / math.e, 0.5 / math.e])
    assert torch.allclose(offsets.std(dim=0), expected, rtol=0.05)


def test_the_most_pulled_come_first_under_the_limit():
    found, _, _ = refined([0.05] * 4, [2e-5, 4e-5, 1e-6, 3e-5], limit=6)
    assert sorted(found["transmittances"].tolist()) == [0.0, 1.0, 1.0, 2.0, 3.0, 3.0]
    assert len(refined([0.05] * 4, [1.0] * 4, limit=3).parameters["means"]) == 4


def test_even_growth_takes_no_notice_of_the_threshold_but_of_being_seen():
    found, _, _ = refined([0.05] * 3, [1e-9, 0.0, 2e-9], limit=10, growth="even")
    assert sorted(found["transmittances"].tolist()) == [0.0, 0.0, 1.0, 2.0, 2.0]


def test_too_large_and_too_small_are_pruned():
    found, origin, _ = refined([1.1, 0.9, 5e-5, 2e-4], [0.0] * 4, limit=10)
    assert sorted(origin.tolist()) == [1, 3]
    assert found["transmittances"].tolist() == [float(place) for place in origin]


def test_pull_is_a_mean_over_the_steps_in_which_a_gaussian_was_seen():
    pull = PullStatistics.empty(3, torch.device("cpu"))
    pull.add(torch.tensor([[3.0, 4.0, 0.0], [0.0, 0.0, 2.0], [0.0, 0.0, 0.0]]))
    pull.add(torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 4.0], [0.0, 0.0, 0.0]]))
    assert pull.mean().tolist() == [5.0, 3.0, 0.0]


def test_rotate():
    half = math.sqrt(0.5)
    quats = 3.0 * torch.tensor([[half, 0.0, 0.0, half]])  # a quarter turn about z, of any norm
    assert torch.allclose(rotate(quats, torch.tensor([[1.0, 2.0, 3.0]])), torch.tensor([[-2.0, 1.0, 3.0]]), atol=1e-6)


def schedule_of(**settings):
    config = TrainingConfig.preset("paper", **{"transmittance_rate": 5e-4, **settings})
    return Schedule(config, scene_scale_cm=5.0, batch_size=8)


def test_released_rates():
    root = 8**0.5
    first = schedule_of().rates(0)
    expected = {"means": 5e-4, "scales": 5e-3, "quats": 5e-3, "transmittances": 5e-4, "sh0": 5e-3, "shN": 1e-5}
    assert first == pytest.approx({name: rate * root for name, rate in expected.items()})
    assert schedule_of().rates(30_000) == pytest.approx({name: rate * 0.1 for name, rate in first.items()})
    assert schedule_of().rates(15_000)["sh0"] == pytest.approx(first["sh0"] * 0.1**0.5)


def test_released_refinements():
    schedule = schedule_of()
    found = [done for done in range(30_001) if schedule.refinement(done) is not None]
    assert found == [2_500, 5_000, 7_500, 10_000, 12_500, 15_000, 17_500]
    assert schedule.gaussian_limit(0) == 500_000


def test_schedules_scale_with_the_run():
    schedule = schedule_of(steps=1_200)
    assert [done for done in range(1_201) if schedule.refinement(done) is not None] == list(range(100, 701, 100))
    assert [schedule.sh_degree(step) for step in (0, 39, 40, 1_199)] == [0, 0, 1, 1]


def test_each_degree_joins_a_while_after_the_last():
    schedule = schedule_of(sh_degree=3)
    assert [schedule.sh_degree(step) for step in (999, 1_000, 2_000, 3_000, 9_000)] == [0, 1, 2, 3, 3]
    assert schedule_of(sh_start=0.0).sh_degree(0) == 1


@pytest.mark.parametrize(
    ("settings", "due"),
    [
        ({"steps": 10, "refinements": 5, "refinement_end": 1.0}, [2, 4, 6, 8, 9]),
        ({"steps": 10, "refinements": 1, "refinement_end": 0.99}, [9]),
        ({"steps": 4, "refinements": 20, "refinement_end": 0.5}, [1, 2]),
    ],
)
def test_even_growth_ends_at_the_limit_however_refinements_fall(settings, due):
    schedule = schedule_of(growth="even", initial_gaussians=100, max_gaussians=170, **settings)
    found = {done: schedule.refinement(done) for done in range(int(settings["steps"]) + 1)}
    places = [place for place in found.values() if place is not None]
    assert [done for done, place in found.items() if place is not None] == due
    assert places == sorted(places)
    assert schedule.gaussian_limit(places[-1]) == 170


def test_floors_hold_for_the_first_part():
    schedule = schedule_of(steps=10, floor_end=0.3)
    assert [schedule.has_floor(step) for step in (0, 2, 3, 9)] == [True, True, False, False]
