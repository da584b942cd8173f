"""The tables of docs/interfaces.md that docs/generate.py writes."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

from .document import DOCUMENT

GENERATOR = Path(__file__).resolve().parents[2] / "docs" / "generate.py"


@pytest.fixture(scope="module")
def generator() -> ModuleType:
    spec = importlib.util.spec_from_file_location("generate_docs", GENERATOR)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_tables_are_current(generator: ModuleType) -> None:
    assert generator.generated(DOCUMENT) == DOCUMENT, "run: make generate"


def test_every_table_has_its_place(generator: ModuleType) -> None:
    for name in generator.TABLES:
        assert DOCUMENT.count(f"<!-- generated: {name} -->\n") == 1
