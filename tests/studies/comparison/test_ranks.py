"""Ranks, and the table of LaTeX that shows them."""

from __future__ import annotations

import numpy as np
import pytest

from ultragray.learn.evaluation.metrics import FrameMetrics
from ultragray.learn.evaluation.scoring import Evaluation
from ultragray.learn.report.tables import by_mean_rank, rank, rank_rows
from ultragray.learn.sweep import Distances
from ultragray_studies.comparison.result import Comparison, DatasetFacts, MethodResult
from ultragray_studies.comparison.tables import duration_text, escaped, latex_table, steps_text
from ultragray_studies.methods.method import Cost, Description


def scores(psnr_db: float, ms_ssim: float, gms: float, gmsd: float) -> Evaluation:
    return Evaluation([FrameMetrics(psnr_db, ms_ssim, gms, gmsd)], np.arange(1), 5, [])


EVALUATIONS = {
    "a": scores(9.5, 0.80, 0.7, 0.20),
    "b": scores(10.5, 0.80, 0.7001, 0.10),  # its GMS reads as that of a
    "c": scores(9.0, 0.70, 0.9, 0.30),
}


def test_ties_share_the_better_place_and_less_of_gmsd_is_better() -> None:
    ranks = rank(EVALUATIONS)
    assert ranks["a"].by_metric == {"psnr_db": 2, "ms_ssim": 1, "gms": 2, "gmsd": 2}
    assert ranks["b"].by_metric == {"psnr_db": 1, "ms_ssim": 1, "gms": 2, "gmsd": 1}
    assert ranks["c"].by_metric == {"psnr_db": 3, "ms_ssim": 3, "gms": 1, "gmsd": 3}
    assert (ranks["a"].mean, ranks["b"].mean, ranks["c"].mean) == (1.75, 1.25, 2.5)
    assert by_mean_rank(EVALUATIONS) == ["b", "a", "c"]
    assert rank({}) == {}


def test_the_first_of_each_column_is_marked() -> None:
    marked = {row.name: [best for _, best in row.cells] for row in rank_rows(EVALUATIONS)}
    assert marked == {
        "a": [False, True, False, False, False],
        "b": [True, True, False, True, True],
        "c": [False, False, True, False, False],
    }


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.25, "0.2 s"), (172.4, "172 s"), (900.0, "15 min"), (90_000.0, "25.0 h")]
)
def test_durations_read_well(seconds: float, text: str) -> None:
    assert duration_text(seconds) == text


def test_the_latex_table_escapes_what_latex_would_read() -> None:
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
