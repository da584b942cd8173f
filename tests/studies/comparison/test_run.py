"""A comparison as a whole: the same table from the same call, and nothing done twice."""

import json
from dataclasses import replace

import numpy as np
import pytest

from ultragray.errors import DatasetInvalid, InvalidArgument, TrainingStateInvalid
from ultragray.learn.evaluation.methods import ComparisonSettings
from ultragray.learn.evaluation.scoring import evaluate_frames
from ultragray.learn.sweep import Distances
from ultragray.scene.gaussians import GaussianScene
from ultragray_studies.comparison.page import render_comparison
from ultragray_studies.comparison.result import MethodResult
from ultragray_studies.comparison.run import EQUAL_TIME, compare_methods, default_paces, frames_of
from ultragray_studies.comparison.tables import latex_table
from ultragray_studies.methods.classical import FromFrames
from ultragray_studies.methods.gaussians import SCENE_FILE
from ultragray_studies.methods.method import Pace, Paces
from ultragray_studies.methods.registry import chosen_methods

from ...model.learn.training.test_agreement import hand_path, recording
from ...model.learn.training.test_poses import shaken
from .conftest import LevelMethod


def table(comparison):
    """All of the rows but their timings."""
    rows = [row.to_dict() for row in comparison.results]
    return [{key: value for key, value in row.items() if key not in ("seconds", "frame_ms")} for row in rows]


def test_each_method_is_a_row_and_one_that_fails_says_why(dataset, methods, paces, tmp_path):
    seen = []
    found = compare_methods(
        dataset, methods, ComparisonSettings(), folder=tmp_path / "run", paces=paces, report=seen.append
    )
    assert [row.name for row in found.results] == list(methods)
    assert found.failures == {"failing": "it needs 9 GB & more"}
    assert list(found.measured) == ["scene", "median", "nearest", "level"]
    assert found.budget_s == 2.0
    level = found.results[3]
    assert (level.title, level.cost.steps, level.cost.of_steps) == ("one level, short", 40, 200)
    assert level.frame_ms > 0.0
    assert [state.method for state in seen if state.fit is None] == list(methods)
    assert {(state.number, state.of) for state in seen} == {(number, 5) for number in range(1, 6)}
    assert [state.fit.step for state in seen if state.fit and state.method == "level"] == list(range(1, 41))
    for name, evaluation in found.measured.items():
        again = evaluate_frames((frames_of(tmp_path / "run", name) / 255.0).astype(np.float32), dataset.val)
        assert again.mean.psnr_db == pytest.approx(evaluation.mean.psnr_db, abs=0.1)  # bytes, rounded


def test_frames_of_a_tracker_that_shakes_are_also_measured_on_the_path(scene_method, paces, tmp_path):
    truth = hand_path()
    chosen = {"scene": scene_method, **chosen_methods(["linear", "median", "in-time"])}
    found = {}
    for name, tracked in (("shaken", shaken(truth, 0.3, 0.2)), ("exact", truth)):
        given = recording(truth, tracked)
        found[name] = compare_methods(given, chosen, ComparisonSettings(), folder=tmp_path / name, paces=paces)
    rows = {one.name: one for one in found["shaken"].results}
    for name in ("linear", "median"):
        assert rows[name].on_path.psnr_db > rows[name].evaluation.mean.psnr_db + 0.5
        assert MethodResult.from_dict(rows[name].to_dict()).on_path == rows[name].on_path
    assert rows["in-time"].on_path is None  # it has no use for poses
    assert rows["in-time"].evaluation.frames == found["exact"].results[3].evaluation.frames
    scene = GaussianScene.load(tmp_path / "shaken" / "scene" / SCENE_FILE)
    assert rows["scene"].on_path.psnr_db == pytest.approx(scene.info.metrics["psnr_db"])
    assert rows["scene"].on_path != rows["scene"].evaluation.mean
    assert "on the path, dB" in latex_table(found["shaken"])
    assert "on the path" not in latex_table(found["exact"])
    assert "on the path, dB" in render_comparison(found["shaken"], recording(truth, truth), tmp_path / "shaken")


@pytest.mark.parametrize("stop_at", [("scene", 2), ("level", 25)])
def test_a_killed_comparison_goes_on_and_repeats_nothing(stop_at, dataset, methods, level, paces, tmp_path):
    class Killed(BaseException):
        pass

    def kill(state):
        if state.fit is not None and (state.method, state.fit.step) == stop_at:
            raise Killed

    settings = ComparisonSettings()
    undisturbed = compare_methods(dataset, methods, settings, folder=tmp_path / "whole", paces=paces)
    level.fits.clear()
    folder = tmp_path / "killed"
    with pytest.raises(Killed):
        compare_methods(dataset, methods, settings, folder=folder, paces=paces, report=kill)
    seen = []
    found = compare_methods(dataset, methods, settings, folder=folder, paces=paces, report=seen.append)
    assert table(found) == table(undisturbed)
    done = list(methods)[: list(methods).index(stop_at[0])]
    assert not [state for state in seen if state.method in done and state.fit is not None]
    fits = len(level.fits)
    again = compare_methods(dataset, methods, settings, folder=folder, paces=paces)
    assert len(level.fits) == fits
    assert [row.cost.seconds for row in again.results] == [row.cost.seconds for row in found.results]


def test_a_folder_of_another_comparison_is_refused(dataset, methods, paces, tmp_path):
    few = {"median": methods["median"]}
    settings = ComparisonSettings()
    assert compare_methods(dataset, few, settings, folder=tmp_path, paces=paces) is not None
    other = replace(dataset, train=dataset.train.select(range(len(dataset.train) - 1)))
    for read, changed, word in (
        (other, settings, "dataset"),
        (dataset, replace(settings, seed=1), "seed 0, this one has 1"),
        (dataset, replace(settings, budget="author"), "budget equal, this one has author"),
    ):
        with pytest.raises(TrainingStateInvalid, match=f"it holds a comparison with {word}"):
            compare_methods(read, few, changed, folder=tmp_path, paces=paces)
    (tmp_path / "run.json").write_text("no json")
    with pytest.raises(TrainingStateInvalid, match=r"run\.json: not the state of a comparison"):
        compare_methods(dataset, few, settings, folder=tmp_path, paces=paces)


@pytest.mark.slow
def test_the_scene_is_fitted_where_the_equal_time_is_not_known_and_only_there(dataset, level, tmp_path, monkeypatch):
    from ultragray_studies.comparison import run
    from ultragray_studies.methods.gaussians import SceneMethod

    tiny = SceneMethod(settings={"steps": 3, "max_gaussians": 30, "batch_size": 2})
    monkeypatch.setattr(run, "SceneMethod", lambda: tiny)
    monkeypatch.setattr(run, "_learns_within_a_time", lambda method: isinstance(method, LevelMethod))
    paces = Paces()
    settings = ComparisonSettings(times=0.5)
    first = compare_methods(dataset, {"level": level}, settings, folder=tmp_path / "one", paces=paces)
    assert [row.name for row in first.results] == ["level"], "the scene is no row: nobody asked for it"
    assert (tmp_path / "one" / "scene" / "scene.ugr").exists()
    assert paces.known(EQUAL_TIME) == Pace(first.budget_s, 0.0)
    second = compare_methods(dataset, {"level": level}, settings, folder=tmp_path / "two", paces=paces)
    assert second is not None
    assert not (tmp_path / "two" / "scene").exists()
    assert table(second) == table(first)
    same_folder = compare_methods(dataset, {"level": level}, settings, folder=tmp_path / "one", paces=Paces())
    assert table(same_folder) == table(first)


def test_where_the_scene_fails_there_is_no_equal_time(dataset, level, tmp_path):
    from ultragray.errors import TrainingDiverged
    from ultragray_studies.methods.gaussians import SceneMethod

    class Diverging(SceneMethod):
        def fit(self, *arguments, **options):
            raise TrainingDiverged("the loss is nan")

    methods = {"scene": Diverging(), "nearest": FromFrames("nearest"), "level": level}
    found = compare_methods(dataset, methods, ComparisonSettings(), folder=tmp_path, paces=Paces())
    assert found.failures == {"scene": "the loss is nan", "level": "there is no equal time, since the scene failed"}
    assert list(found.measured) == ["nearest"]


def test_the_authors_steps_are_those_of_the_author(dataset, level, tmp_path):
    found = compare_methods(dataset, {"level": level}, ComparisonSettings(budget="author"), folder=tmp_path)
    assert (found.results[0].cost.steps, found.results[0].title, found.budget_s) == (200, "one level", None)


def test_without_held_out_frames_nothing_begins(dataset, tmp_path):
    nothing = replace(dataset, val=dataset.val.select([]))
    with pytest.raises(DatasetInvalid, match="no frames to measure with"):
        compare_methods(nothing, chosen_methods(("all",)), ComparisonSettings(), folder=tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_settings_refuse_what_is_not_there():
    with pytest.raises(InvalidArgument, match=r"methods must be some of all, scene, .* got 'nerf'"):
        ComparisonSettings(methods=("scene", "nerf"))
    with pytest.raises(InvalidArgument, match="budget must be one of equal, author, got 'none'"):
        ComparisonSettings(budget="none")


def test_paces_are_kept_for_later_and_a_place_that_cannot_be_written_is_no_error(dataset, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    default_paces(dataset).keep(EQUAL_TIME, Pace(3.0, 0.0))
    assert default_paces(dataset).known(EQUAL_TIME) == Pace(3.0, 0.0)
    assert json.loads((tmp_path / "ultragray" / "paces.json").read_text())
    other = replace(dataset, val=dataset.val.select(np.arange(1)))
    assert default_paces(other).known(EQUAL_TIME) is None
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    paces = default_paces(dataset)
    paces.keep(EQUAL_TIME, Pace(3.0, 0.0))
    assert paces.known(EQUAL_TIME) == Pace(3.0, 0.0)


def test_distances_are_those_to_the_nearest_training_frame(dataset):
    found = Distances.of(dataset)
    places = dataset.val.poses[:, 1, 3][:, None] - dataset.train.poses[:, 1, 3][None]
    np.testing.assert_allclose(found.mm, np.abs(places).min(axis=1), atol=1e-12)
    np.testing.assert_allclose(found.deg, 0.0, atol=1e-6)
