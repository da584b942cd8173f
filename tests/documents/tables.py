"""The tables that people write in the reference, as lists of cells."""

import re

from ..surroundings import ROOT


def rows(page, heading):
    """The cells of the first table below a heading of a page of docs/reference, without the table's own head."""
    text = (ROOT / "docs" / "reference" / page).read_text(encoding="utf-8")
    _, *below = re.split(rf"^#+ {re.escape(heading)}$", text, maxsplit=1, flags=re.MULTILINE)
    section = re.split(r"^#+ ", "".join(below), maxsplit=1, flags=re.MULTILINE)[0]
    table = re.search(r"(?:^\|.*\n)+", section, flags=re.MULTILINE)
    assert table, f"{page} has no table under {heading!r}"
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table[0].splitlines()[2:]]


def code(cell):
    """The words of a cell that stand in backticks."""
    return re.findall(r"`([^`]+)`", cell)
