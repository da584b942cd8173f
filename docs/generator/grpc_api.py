"""Parts about gRPC, from the .proto files and their comments."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from .markdown import code, in_line, prose, sections, table

FILES = sorted((Path(__file__).resolve().parents[2] / "proto" / "ultragray" / "v1").glob("*.proto"))
_BLOCK = re.compile(r"((?:^//.*\n)*)^(message|enum|service) (\w+) \{(?:\}|\n((?s:.*?))^\})$", flags=re.M)
_FIELD = re.compile(r"((?:^ +//.*\n)*)^ +((?:\w|[.<>, ])+?) (\w+) = (\d+);(?: +// (.*))?$", flags=re.M)
_VALUE = re.compile(r"^ +(\w+) = (\d+);(?: +// (.*))?$", flags=re.M)
_METHOD = re.compile(r"((?:^ +//.*\n)*)^ +rpc (\w+)\(([\w ]+)\) returns \(([\w ]+)\)", flags=re.M)


def services() -> str:
    return sections(3, _blocks("service"))


def messages() -> str:
    return sections(3, _blocks("message"))


def enums() -> str:
    return sections(3, _blocks("enum"))


def _blocks(wanted: str) -> Iterator[tuple[str, str]]:
    for path in FILES:
        for comment, kind, name, body in _BLOCK.findall(path.read_text(encoding="utf-8")):
            if kind == wanted:
                yield name, "\n\n".join(part for part in (_words(comment), _BODIES[kind](body)) if part)


def _words(comment: str) -> str:
    return prose(" ".join(line.strip().removeprefix("//").strip() for line in comment.splitlines()))


def _service(body: str) -> str:
    rows = (
        (code(name), code(taken), code(given), _words(comment)) for comment, name, taken, given in _METHOD.findall(body)
    )
    return table(("Method", "Request", "Answer", "Meaning"), rows)


def _message(body: str) -> str:
    rows = (
        (code(name), number, code(kind.replace("google.protobuf.", "")), in_line(f"{_words(above)} {beside}"))
        for above, kind, name, number, beside in _FIELD.findall(body)
    )
    return table(("Field", "Number", "Type", "Meaning"), rows) or "Without fields."


def _enum(body: str) -> str:
    rows = ((code(name), number, in_line(comment)) for name, number, comment in _VALUE.findall(body))
    return table(("Value", "Number", "Meaning"), rows)


_BODIES = {"service": _service, "message": _message, "enum": _enum}
