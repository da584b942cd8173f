"""`ultragray bench` writes what it prints."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ultragray_service.bench import report
from ultragray_service.bench import train as bench
from ultragray_service.bench.kernel import BenchScene
from ultragray_service.bench.train import PARTS


@pytest.mark.parametrize(("quick", "gaussians"), [(True, [300]), (False, [400, 300])])
def test_training_bench(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    quick: bool,
    gaussians: list[int],
) -> None:
    large, small = BenchScene(400, 0.1, height=24, width=20), BenchScene(300, 0.1, height=24, width=20)
    monkeypatch.setattr(bench, "training_scenes", lambda: [large, small])
    monkeypatch.setattr(report, "time_yard_ms", lambda: 4.0)
    bench.run(tmp_path / "bench.json", quick)
    document = json.loads((tmp_path / "bench.json").read_text())
    assert [row["gaussians"] for row in document["rows"]] == gaussians
    assert document["yard_ms"] == 4.0
    assert document.get("quick", False) == quick
    for row in document["rows"]:
        assert row["images"] == "8 of 24x20"
        assert row["step_yards"] == pytest.approx(row["step_ms"] / 4.0)
        assert list(row["shares"]) == list(PARTS)
        assert all(0.0 <= share <= 1.0 for share in row["shares"].values())
    printed = capsys.readouterr().out
    assert "yard 4.0 ms" in printed
    assert f"{document['rows'][-1]['step_ms']:.0f}" in printed
