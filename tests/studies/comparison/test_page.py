"""The page of a comparison: complete, self-contained, and safe with any name."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np

from ultragray.datasets import Dataset
from ultragray.learn.evaluation.methods import ComparisonSettings
from ultragray.learn.evaluation.metrics import FrameMetrics
from ultragray.learn.evaluation.scoring import Evaluation
from ultragray.learn.report.page import telling_places
from ultragray_studies.comparison.page import DISTANCE_BINS, binned_medians, write_comparison
from ultragray_studies.comparison.run import compare_methods
from ultragray_studies.methods.method import Method, Paces

VOID = {"meta", "img", "link", "br"}


class Checked(HTMLParser):
    """Tags that are closed in order, ids, and every address that the page refers to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open_tags: list[str] = []
        self.addresses: list[str] = []
        self.ids: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href")]
        self.ids |= {value or "" for name, value in attrs if name == "id"}
        if tag not in VOID:
            self.open_tags.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open_tags.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open_tags.pop() == tag


def test_the_page_has_every_method_and_needs_nothing_else(
    dataset: Dataset, methods: dict[str, Method], paces: Paces, tmp_path: Path
) -> None:
    found = compare_methods(dataset, methods, ComparisonSettings(), folder=tmp_path, paces=paces)
    assert found is not None
    paths = write_comparison(found, dataset, tmp_path)
    assert [path.name for path in paths] == ["comparison.json", "comparison.tex", "comparison.html"]
    assert json.loads(paths[0].read_text()) == json.loads(json.dumps(found.to_dict()))
    text = paths[2].read_text()
    page = Checked(text)
    assert page.open_tags == []
    assert all(address.startswith(("data:image/png;base64,", "#")) for address in page.addresses)
    assert {address[1:] for address in page.addresses if address.startswith("#")} <= page.ids
    assert "<script" not in text
    assert "url(http" not in text
    assert "<tiny>" not in text
    titles = [row.title for row in found.results]
    assert "one level, short" in titles
    named = re.findall(r'<th scope="row"><a href="#method-[^"]+">(.*?)</a></th>', text)
    measured = len(found.measured)
    assert sorted(named) == sorted([*titles, *(row.title for row in found.results if row.failure is None)])
    shown = re.findall(r'<img src="data:[^"]+" alt="([^"]+) of frame \d+"', text)
    assert len(shown) == 3 * (1 + 2 * measured)
    for row in found.results:
        assert f'<article id="method-{row.name}">' in text
        if row.failure is None:
            assert shown.count(row.title) == shown.count(f"difference of {row.title}") == 3
            assert row.evaluation is not None
            assert f"{row.evaluation.mean.psnr_db:.2f} ± {row.evaluation.std.psnr_db:.2f}" in text
    assert '<td class="failure" colspan="9">it needs 9 GB &amp; more</td>' in text
    assert "<td>40 of 1,000</td>" in text
    assert "Short: 40 of 1,000 steps of its author&#39;s recipe (4 %)." in text
    assert "B = g_0" in text
    assert "g from 0." in text


def test_a_comparison_in_which_all_fail_has_a_page(
    dataset: Dataset, methods: dict[str, Method], tmp_path: Path
) -> None:
    settings = ComparisonSettings()
    found = compare_methods(dataset, {"failing": methods["failing"]}, settings, folder=tmp_path)
    assert found is not None
    text = write_comparison(found, dataset, tmp_path)[2].read_text()
    assert Checked(text).open_tags == []
    assert "it needs 9 GB &amp; more" in text


def test_medians_of_frames_that_are_about_equally_far() -> None:
    distances = np.array([4.0, 1.0, 3.0, 2.0, 8.0, 7.0, 6.0, 5.0] * 4)
    found = binned_medians(distances, 10.0 * distances + np.repeat([0.0, 1.0, 2.0, 30.0], 8))
    assert found.shape == (2, DISTANCE_BINS)
    np.testing.assert_allclose(found[0], np.arange(1.0, 9.0))
    np.testing.assert_allclose(found[1], 10.0 * np.arange(1.0, 9.0) + 1.5)
    alike = binned_medians(np.full(5, 2.0), np.array([1.0, 5.0, 2.0, 3.0, 4.0]))
    assert alike.tolist() == [[2.0], [3.0]]
    two = binned_medians(np.array([1.0, 3.0]), np.array([20.0, 10.0]))
    assert two.tolist() == [[2.0], [15.0]]  # too few for two bins


def test_the_pictures_are_of_the_worst_a_typical_and_the_best_frame() -> None:
    frames = [FrameMetrics(psnr_db, 0.5, 0.5, 0.1) for psnr_db in (20.0, 25.0, 22.0, 30.0, 21.0)]
    evaluation = Evaluation(frames, np.arange(5), 5, [])
    assert telling_places(evaluation) == {0: "worst", 2: "typical", 3: "best"}
    assert len(telling_places(Evaluation(frames[:1], np.arange(1), 5, []))) == 1
