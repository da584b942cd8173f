"""The figures in the documents are those of the files under version control."""

from __future__ import annotations

import copy
from types import ModuleType

import pytest

from ..scripts import benchmark


@pytest.fixture(scope="module")
def documents() -> ModuleType:
    return benchmark("documents")


def test_the_documents_hold_what_was_measured(documents: ModuleType) -> None:
    for page in documents.documents():
        text = page.read_text(encoding="utf-8")
        assert documents.current(text) == text, f"{page}: run benchmarks/documents.py"


def test_every_block_has_its_place(documents: ModuleType) -> None:
    text = "".join(page.read_text(encoding="utf-8") for page in documents.documents())
    for name in documents.BLOCKS:
        assert f"<!-- measured: {name} -->\n" in text


def test_another_measurement_makes_another_document(documents: ModuleType) -> None:
    def read(name: str) -> dict[str, object]:
        measured = copy.deepcopy(documents.kept(name))
        measured["rows"][0]["step_ms"] = 12345.6
        measured["measured"] |= {"commit": "abc", "date": "2030-01-02T00:00:00+00:00"}
        return dict(measured)

    text = "<!-- measured: training steps -->\nold\n<!-- end -->\n"
    new = documents.current(text, read)
    assert "12345.6" in new
    assert "`benchmarks/training.json`: commit abc, 2030-01-02, " in new
    assert "12345.6" not in documents.current(text)
    assert "old" not in documents.current(text)


def test_a_block_names_the_commits_of_what_it_shows(documents: ModuleType) -> None:
    shown = {"one": {"measured": {"commit": "abc", "date": "2030-01-02T00:00:00", "machine": {"processor": "P"}}}}
    hidden = {"two": {"measured": {"commit": "def", "date": "2030-01-03T00:00:00", "machine": {"processor": "P"}}}}
    both = documents.Block("ablations", lambda figures: list(figures))
    assert both.of({**shown, **hidden})[-1] == (
        "`benchmarks/ablations.json`: commit abc, 2030-01-02, P; commit def, 2030-01-03, P."
    )
    one = documents.Block("ablations", lambda figures: list(figures), lambda figures: {"one": figures["one"]})
    assert one.of({**shown, **hidden}) == ["one", "", "`benchmarks/ablations.json`: commit abc, 2030-01-02, P."]
