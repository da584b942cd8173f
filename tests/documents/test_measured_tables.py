"""The figures in README.md and docs/performance.md are those of the files in benchmarks/."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import ModuleType

import pytest

from ..scripts import loaded

WRITER = Path(__file__).resolve().parents[2] / "benchmarks" / "performance.py"


@pytest.fixture(scope="module")
def writer() -> ModuleType:
    return loaded(WRITER)


def test_the_documents_hold_what_was_measured(writer: ModuleType) -> None:
    for document in writer.DOCUMENTS:
        text = document.read_text(encoding="utf-8")
        assert writer.current(text) == text, f"{document}: run benchmarks/performance.py"


def test_every_block_has_its_place(writer: ModuleType) -> None:
    text = "".join(document.read_text(encoding="utf-8") for document in writer.DOCUMENTS)
    for name in writer.BLOCKS:
        assert f"<!-- measured: {name} -->\n" in text


def test_another_measurement_makes_another_document(writer: ModuleType, tmp_path: Path) -> None:
    for file in WRITER.parent.glob("*.json"):
        shutil.copy(file, tmp_path)
    path = tmp_path / "training.json"
    measured = json.loads(path.read_text())
    measured["rows"][0]["step_ms"] = 12345.6
    path.write_text(json.dumps(measured))
    text = "<!-- measured: training steps -->\nold\n<!-- end -->\n"
    assert "12345.6" in writer.current(text, tmp_path)
    assert "12345.6" not in writer.current(text)
    assert "old" not in writer.current(text)
