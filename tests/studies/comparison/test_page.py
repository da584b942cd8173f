"""The page of a comparison, its ranks and its LaTeX: complete, self-contained, and safe with any name."""

import json
import re

import numpy as np
import pytest

from ultragray.learn.evaluation.methods import ComparisonSettings
from ultragray.learn.evaluation.metrics import FrameMetrics
from ultragray.learn.evaluation.scoring import Evaluation
from ultragray.learn.report.page import telling_places
from ultragray.learn.report.tables import by_mean_rank, rank, rank_rows
from ultragray.learn.sweep import Distances
from ultragray_studies.comparison.page import DISTANCE_BINS, binned_medians, write_comparison
from ultragray_studies.comparison.result import Comparison, DatasetFacts, MethodResult
from ultragray_studies.comparison.run import compare_methods
from ultragray_studies.comparison.tables import duration_text, escaped, latex_table, steps_text
from ultragray_studies.methods.method import Cost, Description

from ...model.learn.report.test_page import Checked


def test_the_page_has_every_method_and_needs_nothing_else(dataset, methods, paces, tmp_path):
    found = compare_methods(dataset, methods, ComparisonSettings(), folder=tmp_path, paces=paces)
    paths = write_comparison(found, dataset, tmp_path)
    assert [path.name for path in paths] == ["comparison.json", "comparison.tex", "comparison.html"]
    document = json.loads(paths[0].read_text())
    assert document == json.loads(json.dumps(found.to_dict()))
    again = [MethodResult.from_dict(one).to_dict() for one in document["results"]]
    assert json.loads(json.dumps(again)) == document["results"]
    text = paths[2].read_text()
    page = Checked(text)
    assert {address[1:] for address in page.addresses if address.startswith("#")} <= page.ids
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
            assert f"{row.evaluation.mean.psnr_db:.2f} ± {row.evaluation.std.psnr_db:.2f}" in text
    assert '<td class="failure" colspan="9">it needs 9 GB &amp; more</td>' in text
    assert "<td>40 of 200</td>" in text
    assert "Short: 40 of 200 steps of its author&#39;s recipe (20 %)." in text
    assert "B = g_0" in text
    assert "g from 0." in text


def test_a_comparison_in_which_all_fail_has_a_page(dataset, methods, tmp_path):
    settings = ComparisonSettings()
    found = compare_methods(dataset, {"failing": methods["failing"]}, settings, folder=tmp_path)
    text = write_comparison(found, dataset, tmp_path)[2].read_text()
    Checked(text)
    assert "it needs 9 GB &amp; more" in text


def test_medians_of_frames_that_are_about_equally_far():
    distances = np.array([4.0, 1.0, 3.0, 2.0, 8.0, 7.0, 6.0, 5.0] * 4)
    found = binned_medians(distances, 10.0 * distances + np.repeat([0.0, 1.0, 2.0, 30.0], 8))
    assert found.shape == (2, DISTANCE_BINS)
    np.testing.assert_allclose(found[0], np.arange(1.0, 9.0))
    np.testing.assert_allclose(found[1], 10.0 * np.arange(1.0, 9.0) + 1.5)
    alike = binned_medians(np.full(5, 2.0), np.array([1.0, 5.0, 2.0, 3.0, 4.0]))
    assert alike.tolist() == [[2.0], [3.0]]
    two = binned_medians(np.array([1.0, 3.0]), np.array([20.0, 10.0]))
    assert two.tolist() == [[2.0], [15.0]]  # too few for two bins


def test_the_pictures_are_of_the_worst_a_typical_and_the_best_frame():
    frames = [FrameMetrics(psnr_db, 0.5, 0.5, 0.1) for psnr_db in (20.0, 25.0, 22.0, 30.0, 21.0)]
    evaluation = Evaluation(frames, np.arange(5), 5, [])
    assert telling_places(evaluation) == {0: "worst", 2: "typical", 3: "best"}
    assert len(telling_places(Evaluation(frames[:1], np.arange(1), 5, []))) == 1


def scores(psnr_db, ms_ssim, gms, gmsd):
    return Evaluation([FrameMetrics(psnr_db, ms_ssim, gms, gmsd)], np.arange(1), 5, [])


EVALUATIONS = {
    "a": scores(9.5, 0.80, 0.7, 0.20),
    "b": scores(10.5, 0.80, 0.7001, 0.10),  # its GMS reads as that of a
    "c": scores(9.0, 0.70, 0.9, 0.30),
}


def test_ties_share_the_better_place_and_less_of_gmsd_is_better():
    ranks = rank(EVALUATIONS)
    assert ranks["a"].by_metric == {"psnr_db": 2, "ms_ssim": 1, "gms": 2, "gmsd": 2}
    assert ranks["b"].by_metric == {"psnr_db": 1, "ms_ssim": 1, "gms": 2, "gmsd": 1}
    assert ranks["c"].by_metric == {"psnr_db": 3, "ms_ssim": 3, "gms": 1, "gmsd": 3}
    assert (ranks["a"].mean, ranks["b"].mean, ranks["c"].mean) == (1.75, 1.25, 2.5)
    assert by_mean_rank(EVALUATIONS) == ["b", "a", "c"]
    assert rank({}) == {}


def test_the_first_of_each_column_is_marked():
    marked = {row.name: [best for _, best in row.cells] for row in rank_rows(EVALUATIONS)}
    assert marked == {
        "a": [False, True, False, False, False],
        "b": [True, True, False, True, True],
        "c": [False, False, True, False, False],
    }


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.25, "0.2 s"), (172.4, "172 s"), (900.0, "15 min"), (90_000.0, "25.0 h")]
)
def test_durations_read_well(seconds, text):
    assert duration_text(seconds) == text


def test_the_latex_table_escapes_what_latex_would_read():
    assert escaped("50 % of a_b & c\\d ±") == r"50 \% of a\_b \& c\textbackslash{}d $\pm$"
    rows = [
        MethodResult(
            name=name,
            description=Description(f"{name}_1 & co", "", "", published_steps=200_000),
            machine="a machine",
            cost=Cost(172.0, 1_240, 200_000, 0),
            evaluation=evaluation,
        )
        for name, evaluation in EVALUATIONS.items()
    ]
    failed = MethodResult("d", Description("100 % lost", "", ""), "a machine", failure="it needs 9 GB & more")
    comparison = Comparison(
        dataset=DatasetFacts("a_sweep", "0" * 64, "a probe", 3, 1, 20, 16, 0.1, 0.2),
        machine="a machine",
        budget="equal",
        budget_s=172.0,
        times=1.0,
        seed=0,
        distances=Distances(np.zeros(1), np.zeros(1)),
        results=(*rows, failed),
    )
    text = latex_table(comparison)
    lines = text.splitlines()
    assert r"\toprule" in lines
    assert r"\bottomrule" in lines
    assert r"a\_sweep: mean $\pm$ standard deviation over 1 held-out frames; budget: equal time, 172 s" in text
    first = lines[lines.index(r"\midrule") + 1]
    assert first.startswith(r"b\_1 \& co, short & \textbf{10.50 $\pm$ 0.00} & \textbf{0.800 $\pm$ 0.000} & 0.700 $\pm$")
    assert "1,240 of 200,000 & 172 s" in first
    assert lines[lines.index(r"\bottomrule") - 1] == (
        r"100 \% lost & \multicolumn{9}{l}{failed: it needs 9 GB \& more} \\"
    )
    columns = lines[lines.index(r"\toprule") + 1].count(" & ")
    assert all(line.count(" & ") == columns for line in lines if line.startswith(("a\\_1", "b\\_1", "c\\_1")))
    assert steps_text(rows[0]) == "1,240 of 200,000"
