"""What `make methods` runs: comparisons kept run by run, tables written from them."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from ultragray.learn.evaluation.methods import ComparisonSettings

from ..scripts import benchmark

CLASSICAL = ComparisonSettings(methods=("median", "linear", "nearest"))


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    module = benchmark("methods_tables")
    monkeypatch.setattr(module, "RUNS", (module.Run("one", "ball", CLASSICAL), module.Run("two", "ball", CLASSICAL)))
    return module


def run(script: ModuleType, monkeypatch: pytest.MonkeyPatch, data: Path, *arguments: str) -> dict[str, Any]:
    figures = data / "new" / "figures.json"
    given = [str(data), "--figures", str(figures), "--folder", str(data / "fits"), *arguments]
    monkeypatch.setattr("sys.argv", ["methods_tables.py", *given])
    script.main()
    return dict(json.loads(figures.read_text()))


def test_comparisons_are_kept_one_by_one_and_tabled_together(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, data: Path
) -> None:
    first = run(script, monkeypatch, data, "--only", "two")
    assert list(first) == ["two"]
    assert list(first["two"]["methods"]) == ["median", "linear", "nearest"]
    assert first["two"]["budget_s"] is None
    both = run(script, monkeypatch, data)
    assert both["two"]["methods"] == first["two"]["methods"], "what was measured is not measured again"
    lines = list(script.tables(both))
    assert [line for line in lines if line.startswith("### ")] == ["### one", "### two"]
    rows = [line for line in lines if line.startswith("| ") and "compounding" in line]
    assert len(rows) == 2
    psnr = both["one"]["methods"]["median"]["mean"]["psnr_db"]
    assert f"{psnr:.2f}" in rows[0]


def test_a_method_that_failed_is_a_row_with_its_reason(script: ModuleType) -> None:
    one = {"title": "Linear", "failure": None, "cost": {"steps": "–"}, "mean_rank": 1.0}
    figures = {
        "one": {
            "train_frames": 6,
            "val_frames": 2,
            "image": "16x14",
            "budget_s": 4.0,
            "times": 10.0,
            "order": ["linear"],
            "methods": {
                "linear": {**one, "mean": {"psnr_db": 20.0, "ms_ssim": 0.5, "gms": 0.5, "gmsd": 0.25}},
                "other": {"title": "Other", "failure": "the loss is nan", "cost": {}},
            },
        }
    }
    lines = list(script.tables(figures))
    assert "6 training and 2 held-out frames of 16x14, equal time 40 s." in lines
    assert any("**20.00** | **0.500** | **0.500** | **0.250** | 1.00 |" in line for line in lines)
    assert any(line.startswith("| Other | failed: the loss is nan") for line in lines)
