"""The page: complete, self-contained, and safe with any name."""

import re
from dataclasses import replace

import pytest

from ultragray.learn.evaluation.methods import ComparisonSettings
from ultragray.learn.training import TrainingConfig
from ultragray.learn.training.config import VIEWS_BETWEEN
from ultragray.learn.training.geometry import Geometry
from ultragray_studies import report as report_module
from ultragray_studies.comparison.result import MethodResult
from ultragray_studies.comparison.run import SCENE, compare_methods
from ultragray_studies.methods.gaussians import GivenScene, SceneMethod
from ultragray_studies.report import (
    Failed,
    ReportContent,
    ablation_methods,
    baselines,
    render_report,
    study_tilt,
    train_and_evaluate,
)

from ...model.learn.report.test_page import Checked


@pytest.fixture
def content(turning_dataset, small_config, tmp_path):
    trained = train_and_evaluate(turning_dataset, small_config)
    ablated = ablation_methods(small_config, small_config.max_gaussians or 0)
    methods = {SCENE: GivenScene(trained.scene, trained.course.seconds), **baselines(0.5), **ablated}
    return ReportContent(
        dataset=turning_dataset,
        scene=trained.scene,
        comparison=compared(turning_dataset, methods, tmp_path),
        folder=tmp_path,
        course=trained.course,
        ablations=tuple(ablated),
        tilt=study_tilt(turning_dataset.train, small_config),
    )


def compared(dataset, methods, folder):
    found = compare_methods(dataset, methods, ComparisonSettings(), folder=folder)
    assert found is not None
    return found


def with_failures(content, reason, *names):
    """The same where these methods failed."""
    results = tuple(
        MethodResult(one.name, one.description, one.machine, failure=reason) if one.name in names else one
        for one in content.comparison.results
    )
    return replace(content, comparison=replace(content.comparison, results=results))


def test_the_page_is_whole_and_needs_nothing_else(content):
    text = render_report(content)
    page = Checked(text)
    assert page.open_tags == []
    assert all(address.startswith(("data:image/png;base64,", "#")) for address in page.addresses)
    assert "url(http" not in text
    assert "<script" not in text
    assert text.count("<img ") == 3 * (1 + 2 + 2 + 5 * 2)  # truth, the scene, what it is made of, the baselines
    assert text.count("<svg ") == 5
    assert "turning &lt;sweep&gt;" in text
    assert "turning <sweep>" not in text
    for heading in ("Against the baselines", "Pictures", "Ablations", "Growing tilt", "Training"):
        assert f"<h2>{heading}</h2>" in text
    rows = re.findall(r'<th scope="row">(.*?)</th>', text)
    classical = [
        "median compounding, 0.5 mm",
        "mean compounding, 0.5 mm",
        "maximum compounding, 0.5 mm",
        "linear between frames",
        "nearest training frame",
    ]
    assert rows == [
        *("this scene", *classical),
        *("this scene", *classical),  # their ranks
        *("true frames", "this scene", *classical),
        *("full model", *content.ablations),
        *("scene", "median", "nearest"),
    ]
    mean = content.comparison.measured[SCENE].mean
    assert f"{mean.psnr_db:.2f} ±" in text
    assert f"{mean.gmsd:.3f} ±" in text


def of_rows(content, *names):
    results = tuple(one for one in content.comparison.results if one.name in names)
    return replace(content, comparison=replace(content.comparison, results=results))


def without_ablations(content):
    return replace(of_rows(content, *(one.name for one in content.compared)), ablations=())


def test_a_scene_from_a_file_without_ablations(content):
    text = render_report(replace(without_ablations(content), course=None, tilt=None))
    assert Checked(text).open_tags == []
    assert re.findall(r"<h2>(.*?)</h2>", text) == ["Against the baselines", "Pictures"]


@pytest.mark.long
def test_a_study_that_failed_says_why_in_place_of_its_figures(content):
    name = "half of the Gaussians"
    reason = "it needs 9 GB & more"
    text = render_report(replace(with_failures(content, reason, name), tilt=Failed("<diverged>")))
    assert Checked(text).open_tags == []
    assert f'<th scope="row">{name}</th><td class="failure" colspan="6">it needs 9 GB &amp; more</td></tr>' in text
    rows = re.findall(r'<th scope="row">(.*?)</th>', text)
    assert rows[19:] == ["full model", *content.ablations]
    assert "This study could not be finished: &lt;diverged&gt;" in text
    assert "hardly turns" not in text
    everything = render_report(replace(with_failures(content, reason, *content.ablations), course=None))
    assert everything.count('class="failure"') == len(content.ablations)


def test_a_baseline_that_failed_is_a_row(content):
    text = render_report(with_failures(content, "voxels too small", "linear"))
    assert Checked(text).open_tags == []
    assert '<th scope="row">linear between frames</th><td class="failure" colspan="4">voxels too small</td>' in text


def test_the_plot_of_counts_holds_the_runs_that_differ_in_nothing_else(content, monkeypatch):
    plotted = []
    monkeypatch.setattr(report_module, "plot_counts", lambda points: plotted.extend(points) or "<svg></svg>")
    other = SceneMethod("opaque", "opaque", TrainingConfig(steps=1, max_gaussians=77, transmittance=False).to_dict())
    extra = compared(content.dataset, {"opaque": other}, content.folder)
    comparison = replace(content.comparison, results=(*content.comparison.results, *extra.results))
    render_report(replace(content, comparison=comparison, ablations=(*content.ablations, "opaque")))
    assert sorted(plotted) == [15, 30, 60, 120]


@pytest.mark.long
def test_what_the_data_decides_is_told_as_it_was_decided(turning_dataset, tmp_path):
    dataset = replace(turning_dataset, train=turning_dataset.train.select([3, 4]))
    trained = train_and_evaluate(dataset, TrainingConfig())
    comparison = compared(dataset, {SCENE: GivenScene(trained.scene)}, tmp_path)
    text = render_report(ReportContent(dataset, trained.scene, comparison, tmp_path, course=trained.course))
    steps = Geometry.of(dataset).steps(VIEWS_BETWEEN)
    assert f"{steps:,} steps in " in text
    assert f"<code>steps = {steps}</code>" in text
    assert "= None" not in text.replace("memory_gb = None", "")
