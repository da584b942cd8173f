"""docs/interfaces.md, read, and how it writes a call."""

from __future__ import annotations

import inspect
import re
from enum import Enum
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

DOCUMENT = (Path(__file__).resolve().parents[2] / "docs" / "interfaces.md").read_text(encoding="utf-8")


def rows(heading: str) -> list[list[str]]:
    """The cells of the table below a heading of the document, without the table's own head."""
    _, *below = re.split(rf"^#+ {re.escape(heading)}$", DOCUMENT, maxsplit=1, flags=re.MULTILINE)
    section = re.split(r"^#+ ", "".join(below), maxsplit=1, flags=re.MULTILINE)[0]
    lines = [line.strip("|") for line in section.splitlines() if line.startswith("|")]
    assert lines, f"the document has no table under {heading!r}"
    return [[cell.strip() for cell in line.split("|")] for line in lines[2:]]


def code(cell: str) -> list[str]:
    """What a cell writes in backticks."""
    return re.findall(r"`([^`]+)`", cell)


def table(heading: str) -> dict[str, list[str]]:
    """The rows under a heading, by the name in backticks that each begins with."""
    named = [(code(first)[0], rest) for first, *rest in rows(heading)]
    found = dict(named)
    assert len(found) == len(named), f"a name comes twice under {heading!r}"
    return found


def numbers(cell: str) -> list[float]:
    return [float(number) for number in re.findall(r"\d+(?:\.\d+)?(?:e-?\d+)?", cell)]


def headers_read(package: ModuleType) -> set[str]:
    """The names, in lower case, of the headers or metadata that the modules of a package read, from their text."""
    found = set()
    for path in Path(package.__path__[0]).rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        for literal, constant in re.findall(
            r'(?:eaders(?:\(scope=scope\))?(?:\.get(?:list)?\(|\[)|Header\(alias=)(?:"([\w-]+)"|([A-Z_]+))(?!\] =)',
            text,
        ):
            module = ".".join((package.__name__, *path.relative_to(package.__path__[0]).with_suffix("").parts))
            found.add((literal or getattr(import_module(module), constant)).lower())
    return found


def call_of(value: Any) -> str:
    """`name(parameters, with=defaults)` of a function or class."""
    parts: list[str] = []
    for parameter in inspect.signature(value).parameters.values():
        if isinstance(value, type) and parameter.name == "kind" and parameter.default is not parameter.empty:
            continue  # what tells a member of a family apart is never given
        if parameter.kind is parameter.KEYWORD_ONLY and "*" not in parts:
            parts.append("*")
        default = "" if parameter.default is parameter.empty else f"={_default(parameter.default)}"
        parts.append(parameter.name + default.replace("<factory>", "…"))
    return f"{value.__name__}({', '.join(parts)})"


def _default(value: Any) -> str:
    return f"{type(value).__name__}.{value.name}" if isinstance(value, Enum) else repr(value)
