"""The page: complete, self-contained, and safe with any name."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from ultragray.datasets import Dataset
from ultragray.evaluation.baselines import evaluate_baselines
from ultragray.evaluation.metrics import FrameMetrics
from ultragray.evaluation.scoring import Evaluation
from ultragray.report import page as page_module
from ultragray.report.page import ReportContent, metric_rows, render_page
from ultragray.report.study import Failed, ablations, study_tilt, train_and_evaluate
from ultragray.training import TrainingConfig
from ultragray.training.config import VIEWS_BETWEEN
from ultragray.training.data.geometry import Geometry

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
def content(turning_dataset: Dataset, small_config: TrainingConfig) -> ReportContent:
    trained = train_and_evaluate(turning_dataset, small_config)
    return ReportContent(
        dataset=turning_dataset,
        scene=trained.scene,
        evaluation=trained.evaluation,
        baselines=evaluate_baselines(turning_dataset),
        voxel_mm=0.5,
        machine="a machine",
        trained=trained,
        ablations={
            name: train_and_evaluate(turning_dataset, config)
            for name, config in ablations(small_config, small_config.max_gaussians or 0).items()
        },
        tilt=study_tilt(turning_dataset.train, small_config),
    )


def test_the_page_is_whole_and_needs_nothing_else(content: ReportContent) -> None:
    text = render_page(content)
    page = Checked(text)
    assert page.open_tags == []
    assert all(address.startswith(("data:image/png;base64,", "#")) for address in page.addresses)
    assert "url(http" not in text
    assert "<script" not in text
    assert text.count("<img ") == 3 * 6
    assert text.count("<svg ") == 4
    assert "turning &lt;sweep&gt;" in text
    assert "turning <sweep>" not in text
    for heading in ("Against the baselines", "Pictures", "Ablations", "Growing tilt", "Training"):
        assert f"<h2>{heading}</h2>" in text
    rows = re.findall(r'<th scope="row">(.*?)</th>', text)
    assert rows == [
        "this scene",
        "median compounding",
        "mean compounding",
        "maximum compounding",
        "linear interpolation between frames",
        "nearest training frame",
        "true frames",
        "this scene",
        "median compounding",
        "mean compounding",
        "maximum compounding",
        "linear interpolation between frames",
        "nearest training frame",
        "full model",
        *content.ablations,
        "scene",
        "median",
        "nearest",
    ]
    mean = content.evaluation.mean
    assert f"{mean.psnr_db:.2f} ±" in text
    assert f"{mean.gmsd:.3f} ±" in text


def test_a_scene_from_a_file_without_ablations(content: ReportContent) -> None:
    text = render_page(replace(content, trained=None, ablations={}, tilt=None))
    assert Checked(text).open_tags == []
    assert re.findall(r"<h2>(.*?)</h2>", text) == ["Against the baselines", "Pictures"]


def test_a_scene_alone_with_frames_from_end_to_end(content: ReportContent) -> None:
    alone = replace(content, baselines={}, ablations={}, tilt=None, spread=2, scene_name="ball & <noise>")
    text = render_page(alone)
    assert Checked(text).open_tags == []
    assert re.findall(r"<h2>(.*?)</h2>", text) == ["Held-out frames", "Pictures", "Training"]
    assert "<dt>Scene</dt><dd>ball &amp; &lt;noise&gt;</dd>" in text
    assert re.findall(r'<th scope="row">(.*?)</th>', text) == ["this scene", "true frames", "this scene"]
    first, last = content.dataset.val.frame_numbers[[0, -1]]
    captions = re.findall(r"<figcaption>Frame (\d+): [\d.]+ dB</figcaption>", text)
    assert captions == [str(first), str(last)]
    assert text.count("<img ") == 2 * 5
    everything = render_page(replace(alone, spread=24))
    assert everything.count("<img ") == len(content.dataset.val) * 5


def test_a_study_that_failed_says_why_in_place_of_its_figures(content: ReportContent) -> None:
    name = "half of the Gaussians"
    failed = Failed("it needs 9 GB & more")
    text = render_page(replace(content, ablations={**content.ablations, name: failed}, tilt=Failed("<diverged>")))
    assert Checked(text).open_tags == []
    assert f'<th scope="row">{name}</th><td class="failure" colspan="6">it needs 9 GB &amp; more</td></tr>' in text
    rows = re.findall(r'<th scope="row">(.*?)</th>', text)
    assert rows[13:] == ["full model", *content.ablations]
    assert "This study could not be finished: &lt;diverged&gt;" in text
    assert "hardly turns" not in text
    everything = render_page(replace(content, trained=None, ablations=dict.fromkeys(content.ablations, failed)))
    assert everything.count('class="failure"') == len(content.ablations)


def test_the_plot_of_counts_holds_the_runs_that_differ_in_nothing_else(
    content: ReportContent, monkeypatch: pytest.MonkeyPatch
) -> None:
    plotted: list[int] = []
    monkeypatch.setattr(page_module, "plot_counts", lambda points: plotted.extend(points) or "<svg></svg>")
    other = train_and_evaluate(content.dataset, TrainingConfig(steps=1, max_gaussians=77, transmittance=False))
    render_page(replace(content, ablations={**content.ablations, "opaque Gaussians": other}))
    assert sorted(plotted) == [15, 30, 60, 120]


def test_what_the_data_decides_is_told_as_it_was_decided(turning_dataset: Dataset) -> None:
    dataset = replace(turning_dataset, train=turning_dataset.train.select([3, 4]))
    trained = train_and_evaluate(dataset, TrainingConfig())
    text = render_page(
        ReportContent(
            dataset=dataset,
            scene=trained.scene,
            evaluation=trained.evaluation,
            baselines=evaluate_baselines(dataset, ("median",)),
            voxel_mm=0.5,
            machine="a machine",
            trained=trained,
        )
    )
    steps = Geometry.of(dataset).steps(VIEWS_BETWEEN)
    assert f"{steps:,} steps in " in text
    assert f"<code>steps = {steps}</code>" in text
    assert "= None" not in text.replace("memory_gb = None", "")


def test_one_held_out_frame_is_shown_once(content: ReportContent) -> None:
    val = content.dataset.val.select([0])
    alone = Evaluation(content.evaluation.frames[:1], val.frame_numbers, 1, content.evaluation.frame_speckle[:1])
    dataset = replace(content.dataset, val=val)
    text = render_page(
        replace(content, dataset=dataset, evaluation=alone, baselines=evaluate_baselines(dataset), ablations={})
    )
    assert text.count("<figcaption>") == 1


def test_the_best_of_each_column_is_marked_as_numbers_not_as_words() -> None:
    def of(psnr_db: float, gmsd: float) -> Evaluation:
        return Evaluation([FrameMetrics(psnr_db, 0.5, 0.5, gmsd)], np.arange(1), 5, [])

    rows = metric_rows({"a": of(9.5, 0.2), "b": of(10.5, 0.1)})
    assert [[best for _, best in row.cells] for row in rows] == [[False, True, True, False], [True, True, True, True]]
    assert [best for _, best in metric_rows({"a": of(9.5, 0.2)})[0].cells] == [False] * 4
