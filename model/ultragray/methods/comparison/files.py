"""The files of a comparison: what it found as JSON, as a table of LaTeX and as a page."""

from __future__ import annotations

import json
from pathlib import Path

from ultragray.datasets.sweep import Dataset
from ultragray.files.atomic import write_whole
from ultragray.methods.comparison.latex import latex_table
from ultragray.methods.comparison.page import render_comparison
from ultragray.methods.comparison.result import RESULT_FILE, Comparison

TABLE_FILE, PAGE_FILE = "comparison.tex", "comparison.html"


def write_comparison(comparison: Comparison, dataset: Dataset, folder: Path) -> list[Path]:
    """Writes them into the comparison's folder and returns their paths; each needs nothing else of the folder."""
    contents = {
        RESULT_FILE: json.dumps(comparison.to_dict(), indent=1) + "\n",
        TABLE_FILE: latex_table(comparison),
        PAGE_FILE: render_comparison(comparison, dataset, folder),
    }
    for name, content in contents.items():
        write_whole(folder / name, content)
    return [folder / name for name in contents]
