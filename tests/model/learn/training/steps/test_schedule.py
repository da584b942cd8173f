"""When what happens; the released numbers are those of its 30,000 steps."""

import pytest

from ultragray.learn.training import TrainingConfig
from ultragray.learn.training.optimizer import Schedule


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


def test_no_refinement_at_the_ends_of_a_very_short_run():
    schedule = schedule_of(steps=3)
    assert [schedule.refinement(done) is None for done in (0, 3)] == [True, True]


def test_each_degree_joins_a_while_after_the_last():
    schedule = schedule_of(sh_degree=3)
    assert [schedule.sh_degree(step) for step in (999, 1_000, 2_000, 3_000, 9_000)] == [0, 1, 2, 3, 3]
    assert schedule_of(sh_start=0.0).sh_degree(0) == 1


def test_even_growth_ends_at_the_limit():
    schedule = schedule_of(growth="even", initial_gaussians=100, max_gaussians=170)
    assert [schedule.gaussian_limit(k) for k in range(7)] == [110, 120, 130, 140, 150, 160, 170]


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
