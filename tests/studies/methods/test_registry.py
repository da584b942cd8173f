"""The methods by name."""

import numpy as np
import pytest
import torch

from ultragray.errors import InvalidArgument
from ultragray.learn.evaluation.baselines import predict
from ultragray.learn.evaluation.methods import NAMES
from ultragray_studies.methods.method import Budget, FitRun
from ultragray_studies.methods.registry import METHODS, chosen_methods
from ultragray_studies.methods.ultranerf import VARIANTS

from .volumes import along_elevation, one_frame, psnr_of_fit, seen, steps_of


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_each_method_says_what_it_is(method):
    told = method.describe()
    assert told.title
    assert told.source
    assert told.summary.endswith(".")
    assert told.published_steps is None or told.published_steps > 0
    assert len({one.describe().title for one in METHODS.values()}) == len(METHODS)


def test_the_names_are_those_of_the_registry_in_its_order():
    assert tuple(METHODS) == NAMES


def test_methods_are_chosen_in_the_order_of_tables():
    assert list(chosen_methods(["nearest", "scene", "nearest"])) == ["scene", "nearest"]
    assert chosen_methods(["nearest", "all"]) == METHODS


@pytest.mark.parametrize(("names", "got"), [(["medain"], "'medain'"), (["all", "x"], "'x'"), ([], "none")])
def test_a_method_that_is_not_there_is_refused_with_the_list(names, got):
    with pytest.raises(InvalidArgument, match=f"scene, median, mean, maximum.* got {got}") as caught:
        chosen_methods(names)
    assert caught.value.field == "methods"


@pytest.mark.parametrize("name", ["median", "maximum", "linear", "nearest"])
def test_a_classical_method_predicts_what_the_baseline_does(name, make_dataset):
    dataset = make_dataset()
    fitted = METHODS[name].fit(dataset, Budget.equal(1.0))
    assert (fitted.cost.steps, fitted.cost.of_steps, fitted.cost.is_short) == (0, None, False)
    height, width = dataset.val.height, dataset.val.width
    rendered = fitted.render(dataset.probe, dataset.val.poses, height, width)
    np.testing.assert_array_equal(rendered, predict(dataset.train, dataset.val.poses, name))


# Steps: of a short fit, and until a frame is learned.
FIELDS = {"implicitvol": (24, 60), "implicitvol-refined": (24, 140), "rapidvol": (16, 200)}
SHORT = {**{name: steps for name, (steps, _) in FIELDS.items()}, **{one.name: 10 for one in VARIANTS}}


@pytest.mark.parametrize("name", SHORT)
def test_a_killed_fit_ends_in_the_model_of_an_undisturbed_one(name, tmp_path):
    method, dataset, told = METHODS[name], seen(along_elevation(np.arange(3.0)), (12, 8)), []
    budget = steps_of(method, SHORT[name])
    stopping = FitRun(folder=tmp_path, report=told.append, should_stop=lambda: len(told) == 7)
    assert method.fit(dataset, budget, stopping) is None
    resumed, undisturbed = method.fit(dataset, budget, FitRun(folder=tmp_path)), method.fit(dataset, budget)
    models = resumed.learner.model(), undisturbed.learner.model()
    assert models[0].keys() == models[1].keys()
    assert all(torch.equal(tensor, models[1][key]) for key, tensor in models[0].items())


@pytest.mark.slow
@pytest.mark.parametrize("name", FIELDS)
def test_a_single_frame_is_fitted_above_30_db(name):
    method = METHODS[name]
    assert psnr_of_fit(method, one_frame(32, 24), FIELDS[name][1]) > 30.0
