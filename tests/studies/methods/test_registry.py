"""The methods by name."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ultragray.errors import InvalidArgument
from ultragray.learn.evaluation.baselines import predict
from ultragray.learn.sweep import Dataset
from ultragray_studies.methods.method import Budget, Method
from ultragray_studies.methods.registry import METHODS, chosen_methods


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_each_method_says_what_it_is(method: Method) -> None:
    told = method.describe()
    assert told.title
    assert told.source
    assert told.summary.endswith(".")
    assert told.published_steps is None or told.published_steps > 0
    assert len({one.describe().title for one in METHODS.values()}) == len(METHODS)


def test_methods_are_chosen_in_the_order_of_tables() -> None:
    assert list(chosen_methods(["nearest", "scene"])) == ["scene", "nearest"]
    assert chosen_methods(["all"]) == METHODS


@pytest.mark.parametrize("names", [["medain"], ["all", "x"], []])
def test_a_method_that_is_not_there_is_refused_with_the_list(names: list[str]) -> None:
    with pytest.raises(InvalidArgument, match="scene, median, mean, maximum") as caught:
        chosen_methods(names)
    assert caught.value.field == "methods"


@pytest.mark.parametrize("name", ["median", "maximum", "linear", "nearest"])
def test_a_classical_method_predicts_what_the_baseline_does(name: str, make_dataset: Callable[..., Dataset]) -> None:
    dataset = make_dataset()
    fitted = METHODS[name].fit(dataset, Budget.equal(1.0))
    assert fitted is not None
    assert (fitted.cost.steps, fitted.cost.of_steps, fitted.cost.is_short) == (0, None, False)
    height, width = dataset.val.height, dataset.val.width
    rendered = fitted.render(dataset.probe, dataset.val.poses, height, width)
    np.testing.assert_array_equal(rendered, predict(dataset.train, dataset.val.poses, name))
