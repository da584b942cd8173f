"""Budgets: an equal time becomes a number of steps, and the same number when it is asked again."""

import pytest

from ultragray.errors import InvalidArgument
from ultragray_studies.methods.method import Budget, Pace, Paces


def never():
    raise AssertionError("it was measured again")


def test_an_author_gets_the_published_steps():
    assert Budget.author().steps("any", 200_000, never) == 200_000


def test_an_equal_time_holds_the_start_and_the_steps():
    assert Budget.equal(10.0).steps("any", 200_000, lambda: Pace(start_s=1.0, step_s=0.09)) == 100


def test_a_time_that_is_too_short_still_holds_a_step():
    assert Budget.equal(0.5).steps("any", 10, lambda: Pace(start_s=1.0, step_s=3.0)) == 1


@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan"), float("inf")])
def test_a_time_that_is_none_is_refused(seconds):
    with pytest.raises(InvalidArgument, match="must be positive"):
        Budget.equal(seconds)


def test_a_pace_is_measured_once_on_a_machine(tmp_path):
    path = tmp_path / "cache" / "paces.json"
    here = {"processor": "one", "threads": 2}
    first = Budget.equal(10.0, Paces(path, here)).steps("any", 9, lambda: Pace(0.0, 0.1))
    assert Budget.equal(10.0, Paces(path, here)).steps("any", 9, never) == first == 100
    assert Budget.equal(10.0, Paces(path, here)).steps("another", 9, lambda: Pace(0.0, 1.0)) == 10
    elsewhere = {"processor": "another", "threads": 2}
    assert Budget.equal(10.0, Paces(path, elsewhere)).steps("any", 9, lambda: Pace(0.0, 0.2)) == 50


def test_a_fit_that_used_a_part_of_its_time_shows_its_pace():
    budget = Budget.equal(10.0)
    budget.steps("any", 9, lambda: Pace(1.0, 0.9, is_confirmed=False))
    assert budget.shown_pace("any", 10, 9.0) is None  # as promised
    assert budget.shown_pace("any", 10, 4.0) == Pace(1.0, 0.3, is_confirmed=False)
    budget.paces.confirm("any")
    assert budget.shown_pace("any", 10, 4.0) is None  # the table stays
    assert Budget.author().shown_pace("any", 10, 4.0) is None


@pytest.mark.parametrize("content", ["", "[]", '{"{}": {"any": ["x", 1, true]}}', '{"{}": {"any": [1]}}', '{"{}": 3}'])
def test_a_damaged_file_of_paces_is_measured_again(tmp_path, content):
    path = tmp_path / "paces.json"
    path.write_text(content)
    assert Paces(path).get("any", lambda: Pace(1.0, 2.0)) == Pace(1.0, 2.0)
    assert Paces(path).get("any", never) == Pace(1.0, 2.0)
