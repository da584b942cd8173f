"""The notebooks: each runs from top to bottom in a kernel of its own, and their files are in one form."""

import nbformat
import pytest

from ..scripts import loaded
from .conftest import ROOT

notebooks = loaded(ROOT / "docs" / "notebooks.py")
NAMES = [path.stem for path in notebooks.notebooks()]


@pytest.mark.parametrize("name", NAMES)
def test_its_file_is_in_the_form_that_the_formatter_gives(name):
    path = notebooks.FOLDER / f"{name}.ipynb"
    text = path.read_text(encoding="utf-8")
    assert notebooks.in_form(nbformat.reads(text, as_version=4)) == text, "run: make format"


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
def test_it_runs_from_top_to_bottom(name, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")  # other tests run beside it
    notebook = notebooks.executed(notebooks.FOLDER / f"{name}.ipynb")
    assert notebooks.picture_of(notebook).startswith(b"\x89PNG")
    told = [output for cell in notebook.cells for output in cell.get("outputs", ()) if output.get("name") == "stderr"]
    assert not told, "it warns"
    if name == "visual_servoing":
        assert "found in 13 of 13 frames" in str(notebook)
