"""Pieces of Markdown that the parts are made of."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable

Row = Iterable[str]

_CODE = re.compile(r"(`[^`]*`)")
_PAGE = re.compile(r"docs/([\w/-]+\.md)")


def table(head: Row, rows: Iterable[Row]) -> str:
    """A table, or nothing where it has no rows."""
    lines = [f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |" for row in rows]
    names = list(head)
    return "\n".join([f"| {' | '.join(names)} |", "|---" * len(names) + "|", *lines, ""]) if lines else ""


def code(text: object) -> str:
    return f"`{text}`"


def codes(words: Iterable[object]) -> str:
    return ", ".join(map(code, words))


def in_line(text: str) -> str:
    """Words in one line, without the full stop at the end."""
    return prose(" ".join(text.split()).removesuffix("."))


def prose(text: str) -> str:
    """Text of the code for a page of the reference.

    What looks like a tag of HTML, such as `<name>` outside of code, is made harmless; the name of another page, such as
    docs/physics.md, becomes a link.
    """
    return "".join(
        part if part.startswith("`") else _PAGE.sub(r"[\1](../\1)", part.replace("<", "&lt;"))
        for part in _CODE.split(text)
    )


def summary(thing: object) -> str:
    """The first paragraph of a docstring, in one line."""
    return in_line((inspect.getdoc(thing) or "").partition("\n\n")[0])


def sections(level: int, parts: Iterable[tuple[str, str]]) -> str:
    """Headings with their text."""
    return "\n".join(f"{'#' * level} {heading}\n\n{text.strip()}\n" for heading, text in parts)
