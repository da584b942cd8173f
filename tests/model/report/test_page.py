"""The page: complete, self-contained, and safe with any name."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from ultragray.datasets import Dataset
from ultragray.learn.evaluation.methods import ComparisonSettings
from ultragray.learn.evaluation.metrics import FrameMetrics
from ultragray.learn.evaluation.scoring import Evaluation
from ultragray.learn.training import TrainingConfig
from ultragray.learn.training.config import VIEWS_BETWEEN
from ultragray.learn.training.geometry import Geometry
from ultragray_studies.comparison.result import Comparison, MethodResult
from ultragray_studies.comparison.run import SCENE, compare_methods
from ultragray_studies.comparison.tables import metric_rows
from ultragray_studies.methods.gaussians import GivenScene, SceneMethod
from ultragray_studies.methods.method import Method
from ultragray_studies.report import page as page_module
from ultragray_studies.report.page import ReportContent, render_page
from ultragray_studies.report.study import Failed, ablation_methods, baselines, study_tilt, train_and_evaluate

VOID = {"meta", "img", "link", "br"}


class Checked(HTMLParser):
    """Tags that are closed in order, and every address that the page refers to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open_tags: list[str] = []
        self.addresses: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href")]
        if tag not in VOID:
            self.open_tags.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open_tags.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open_tags.pop() == tag


@pytest.fixture
def content(turning_dataset: Dataset, small_config: TrainingConfig, tmp_path: Path) -> ReportContent:
    trained = train_and_evaluate(turning_dataset, small_config)
    ablated = ablation_methods(small_config, small_config.max_gaussians or 0)
    methods = {SCENE: GivenScene(trained.scene, trained.seconds), **baselines(0.5), **ablated}
    return ReportContent(
        dataset=turning_dataset,
        scene=trained.scene,
        comparison=compared(turning_dataset, methods, tmp_path),
        folder=tmp_path,
        trained=trained,
        ablations=tuple(ablated),
        tilt=study_tilt(turning_dataset.train, small_config),
    )


def compared(dataset: Dataset, methods: dict[str, Method], folder: Path) -> Comparison:
    found = compare_methods(dataset, methods, ComparisonSettings(), folder=folder)
    assert found is not None
    return found


def with_failures(content: ReportContent, reason: str, *names: str) -> ReportContent:
    """The same where these methods failed."""
    results = tuple(
        MethodResult(one.name, one.description, one.machine, failure=reason) if one.name in names else one
        for one in content.comparison.results
    )
    return replace(content, comparison=replace(content.comparison, results=results))


def test_the_page_is_whole_and_needs_nothing_else(content: ReportContent) -> None:
    text = render_page(content)
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


def of_rows(content: ReportContent, *names: str) -> ReportContent:
    results = tuple(one for one in content.comparison.results if one.name in names)
    return replace(content, comparison=replace(content.comparison, results=results))


def without_ablations(content: ReportContent) -> ReportContent:
    return replace(of_rows(content, *(one.name for one in content.compared)), ablations=())


def test_a_scene_from_a_file_without_ablations(content: ReportContent) -> None:
    text = render_page(replace(without_ablations(content), trained=None, tilt=None))
    assert Checked(text).open_tags == []
    assert re.findall(r"<h2>(.*?)</h2>", text) == ["Against the baselines", "Pictures"]


@pytest.mark.long
def test_a_scene_alone_with_frames_from_end_to_end(content: ReportContent) -> None:
    alone = replace(of_rows(content, SCENE), ablations=(), tilt=None, spread=2, scene_name="ball & <noise>")
    text = render_page(alone)
    assert Checked(text).open_tags == []
    assert re.findall(r"<h2>(.*?)</h2>", text) == ["Held-out frames", "Pictures", "Training"]
    assert "<dt>Scene</dt><dd>ball &amp; &lt;noise&gt;</dd>" in text
    assert re.findall(r'<th scope="row">(.*?)</th>', text) == ["this scene", "true frames", "this scene"]
    first, last = content.dataset.val.frame_numbers[[0, -1]]
    captions = re.findall(r"<figcaption>Frame (\d+)</figcaption>", text)
    assert captions == [str(first), str(last)]
    assert text.count("<img ") == 2 * 5
    everything = render_page(replace(alone, spread=24))
    assert everything.count("<img ") == len(content.dataset.val) * 5


@pytest.mark.long
def test_a_study_that_failed_says_why_in_place_of_its_figures(content: ReportContent) -> None:
    name = "half of the Gaussians"
    reason = "it needs 9 GB & more"
    text = render_page(replace(with_failures(content, reason, name), tilt=Failed("<diverged>")))
    assert Checked(text).open_tags == []
    assert f'<th scope="row">{name}</th><td class="failure" colspan="6">it needs 9 GB &amp; more</td></tr>' in text
    rows = re.findall(r'<th scope="row">(.*?)</th>', text)
    assert rows[19:] == ["full model", *content.ablations]
    assert "This study could not be finished: &lt;diverged&gt;" in text
    assert "hardly turns" not in text
    everything = render_page(replace(with_failures(content, reason, *content.ablations), trained=None))
    assert everything.count('class="failure"') == len(content.ablations)


def test_a_baseline_that_failed_is_a_row(content: ReportContent) -> None:
    text = render_page(with_failures(content, "voxels too small", "linear"))
    assert Checked(text).open_tags == []
    assert '<th scope="row">linear between frames</th><td class="failure" colspan="4">voxels too small</td>' in text


def test_the_plot_of_counts_holds_the_runs_that_differ_in_nothing_else(
    content: ReportContent, monkeypatch: pytest.MonkeyPatch
) -> None:
    plotted: list[int] = []
    monkeypatch.setattr(page_module, "plot_counts", lambda points: plotted.extend(points) or "<svg></svg>")
    other = SceneMethod("opaque", "opaque", TrainingConfig(steps=1, max_gaussians=77, transmittance=False).to_dict())
    extra = compared(content.dataset, {"opaque": other}, content.folder)
    comparison = replace(content.comparison, results=(*content.comparison.results, *extra.results))
    render_page(replace(content, comparison=comparison, ablations=(*content.ablations, "opaque")))
    assert sorted(plotted) == [15, 30, 60, 120]


@pytest.mark.long
def test_what_the_data_decides_is_told_as_it_was_decided(turning_dataset: Dataset, tmp_path: Path) -> None:
    dataset = replace(turning_dataset, train=turning_dataset.train.select([3, 4]))
    trained = train_and_evaluate(dataset, TrainingConfig())
    comparison = compared(dataset, {SCENE: GivenScene(trained.scene)}, tmp_path)
    text = render_page(ReportContent(dataset, trained.scene, comparison, tmp_path, trained=trained))
    steps = Geometry.of(dataset).steps(VIEWS_BETWEEN)
    assert f"{steps:,} steps in " in text
    assert f"<code>steps = {steps}</code>" in text
    assert "= None" not in text.replace("memory_gb = None", "")


def test_one_held_out_frame_is_shown_once(content: ReportContent, tmp_path: Path) -> None:
    dataset = replace(content.dataset, val=content.dataset.val.select([0]))
    folder = tmp_path / "alone"
    comparison = compared(dataset, {SCENE: GivenScene(content.scene), **baselines(0.5)}, folder)
    text = render_page(replace(content, dataset=dataset, comparison=comparison, folder=folder, ablations=()))
    assert text.count("<figcaption>") == 1


def test_the_best_of_each_column_is_marked_as_numbers_not_as_words() -> None:
    def of(psnr_db: float, gmsd: float) -> Evaluation:
        return Evaluation([FrameMetrics(psnr_db, 0.5, 0.5, gmsd)], np.arange(1), 5, [])

    rows = metric_rows({"a": of(9.5, 0.2), "b": of(10.5, 0.1)})
    assert [[best for _, best in row.cells] for row in rows] == [[False, True, True, False], [True, True, True, True]]
    assert [best for _, best in metric_rows({"a": of(9.5, 0.2)})[0].cells] == [False] * 4
