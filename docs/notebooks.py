"""Keeps the notebooks in examples/notebooks in one form, and takes their pictures for the documents.

    python docs/notebooks.py                    # rewrites every notebook in its form; `make format` does it
    python docs/notebooks.py --pictures NAME …  # runs these (none named: all), their pictures go into docs/images

The form has no outputs: a notebook's results depend on the machine and the moment, and would hide a change of its text
in a diff. The tests run every notebook, so that what it would show is never out of date. Cells are numbered by
their place, and the metadata is that of any Python notebook. Ruff formats the code.
"""

from __future__ import annotations

import argparse
import base64
import shutil
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbformat import NotebookNode

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "examples" / "notebooks"
IMAGES = ROOT / "docs" / "images"
PICTURE = "picture"  # tag of the cell whose picture the documents show
CELL_TIMEOUT_S = 1200
METADATA = {
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {"name": "python"},
}


def notebooks() -> list[Path]:
    """All notebooks, by name."""
    return sorted(FOLDER.glob("*.ipynb"))


def in_form(notebook: NotebookNode) -> str:
    """The text of a notebook's file, without outputs."""
    formed = nbformat.v4.new_notebook(metadata=METADATA)
    for number, cell in enumerate(notebook.cells, 1):
        tags = {"tags": cell.metadata["tags"]} if cell.metadata.get("tags") else {}
        make = {"markdown": nbformat.v4.new_markdown_cell, "code": nbformat.v4.new_code_cell}[cell.cell_type]
        formed.cells.append(make(cell.source.strip("\n"), id=f"cell-{number}", metadata=tags))
    nbformat.validate(formed)
    return nbformat.writes(formed) + "\n"


def executed(path: Path) -> NotebookNode:
    """The notebook with its outputs, run by a kernel of its own in a copy of its folder.

    Raises CellExecutionError, which shows the cell, and CellTimeoutError.
    """
    with tempfile.TemporaryDirectory() as folder:
        for module in FOLDER.glob("*.py"):
            shutil.copy(module, folder)
        notebook = nbformat.read(path, as_version=4)
        place = {"metadata": {"path": folder}}
        return NotebookClient(notebook, timeout=CELL_TIMEOUT_S, resources=place).execute()


def picture_of(notebook: NotebookNode) -> bytes:
    """The PNG of the last picture in the cell with the tag. Raises ValueError where there is none."""
    for cell in notebook.cells:
        if PICTURE in cell.metadata.get("tags", ()):
            pictures = [output.data["image/png"] for output in cell.outputs if "image/png" in output.get("data", {})]
            if pictures:
                return base64.b64decode(pictures[-1])
    raise ValueError(f"no cell with the tag {PICTURE!r} drew a picture")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pictures", nargs="*", metavar="NAME", help="run these notebooks, and take their pictures")
    given = parser.parse_args()
    for path in notebooks():
        path.write_text(in_form(nbformat.read(path, as_version=4)), encoding="utf-8")
    if given.pictures is not None:
        for name in given.pictures or [path.stem for path in notebooks()]:
            picture = picture_of(executed(FOLDER / f"{name}.ipynb"))
            (IMAGES / f"notebook_{name}.png").write_bytes(picture)


if __name__ == "__main__":
    main()
