"""The tables of docs/interfaces.md that docs/generate.py writes."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pytest

from ..scripts import loaded
from .document import DOCUMENT

GENERATOR = Path(__file__).resolve().parents[2] / "docs" / "generate.py"


@pytest.fixture(scope="module")
def generator() -> ModuleType:
    return loaded(GENERATOR)


def test_tables_are_current(generator: ModuleType) -> None:
    assert generator.generated(DOCUMENT) == DOCUMENT, "run: make generate"


def test_every_table_has_its_place(generator: ModuleType) -> None:
    for name in generator.TABLES:
        assert DOCUMENT.count(f"<!-- generated: {name} -->\n") == 1
