"""Writes the tables of docs/interfaces.md that follow from the code: `python docs/generate.py`, or `make generate`.

Such a table stands between `<!-- generated: NAME -->` and `<!-- end -->`, and TABLES says what makes it.
"""

from __future__ import annotations

import inspect
import json
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import MISSING, Field
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any, get_args

import typer

from ultragray import errors
from ultragray.confidence import FIGURES, Extrapolation
from ultragray.contract import annotated_fields, limits_in_words, range_of, to_dict
from ultragray.display.settings import Display
from ultragray.interchange.exports import FORMATS
from ultragray.outputs import OUTPUTS
from ultragray.settings import RenderSettings
from ultragray_client import contract as client_contract
from ultragray_client import errors as client_errors
from ultragray_service import errors as service_errors
from ultragray_service.cli.app import app as command_line
from ultragray_service.core.state import Service
from ultragray_service.errors import statuses_of
from ultragray_service.http.app import create_app
from ultragray_service.http.reading.bodies import RenderBody, StreamMessage
from ultragray_service.http.stream_messages import FrameMessage
from ultragray_service.settings import ENVIRONMENT_PREFIX, Settings
from ultragray_workers import errors as workers_errors

DOCS = Path(__file__).resolve().parent
DOCUMENT = DOCS / "interfaces.md"
PROTO_FILES = sorted((DOCS.parent / "proto" / "ultragray" / "v1").glob("*.proto"))
_GENERATED = re.compile(r"(?<=<!-- generated: )([\w -]+?)( -->\n).*?(?=<!-- end -->)", flags=re.DOTALL)
_BLOCK = re.compile(r"^(message|enum) (\w+) \{\n(.*?)^\}", flags=re.DOTALL | re.MULTILINE)
_DECLARATION = re.compile(r"^ +((?:\w|[.<>, ])+? = \d+);(?: +// (.*))?$", flags=re.MULTILINE)

Row = Iterable[str]
Table = Iterable[Row]  # its head first


def generated(document: str) -> str:
    """The document with its tables as the code has them now."""
    return _GENERATED.sub(lambda match: f"{match[1]}{match[2]}{_written(TABLES[match[1]]())}", document)


def _written(table: Table) -> str:
    head, *rows = (list(row) for row in table)
    return f"| {' | '.join(head)} |\n{'|---' * len(head)}|\n" + "".join(f"| {' | '.join(row)} |\n" for row in rows)


def error_table() -> Iterator[Row]:
    """The errors of each module, in their order there."""
    yield "Reason", "Class", "In", "HTTP", "gRPC", "Meaning"
    for module in (errors, workers_errors, service_errors):
        for cls in errors.error_classes():
            if cls.__module__ == module.__name__:
                arrow, statuses = "↳ " if cls.__base__ is errors.InvalidArgument else "", statuses_of(cls)
                name = f"{arrow}`{cls.__name__}`"
                yield f"`{cls.reason}`", name, f"`{module.__name__}`", str(statuses.http), statuses.grpc, _meaning(cls)


def output_table() -> Iterator[Row]:
    """The registry of outputs."""
    yield "Output", "Meaning", "Pixels"
    for output in OUTPUTS.values():
        yield f"`{output.name}`", output.meaning, "whole numbers" if output.is_numbers else "0 to 1"


def field_table(cls: type[Any], head: str) -> Iterator[Row]:
    """The fields of a class of the contract."""
    yield head, "Default", "Meaning"
    for item, _ in annotated_fields(cls):
        yield f"`{item.name}`", f"`{_default(item)}`", _described(item)


def told_table(cls: type[Any], head: str) -> Iterator[Row]:
    """The fields of a class that the service tells."""
    yield head, "Meaning"
    for item, _ in annotated_fields(cls):
        yield f"`{item.name}`", _described(item)


def object_table() -> Iterator[Row]:
    """The schemas of the OpenAPI document that have keys, but for those with tables of their own."""
    yield "Object", "Keys", "Meaning"
    with tempfile.TemporaryDirectory() as folder:
        document = create_app(Service(Settings(data_folder=Path(folder)))).openapi()
    tabled = {cls.__name__ for cls in (RenderBody, StreamMessage, RenderSettings, FrameMessage, Display, Extrapolation)}
    for name, schema in sorted(document["components"]["schemas"].items()):
        if name not in tabled and "properties" in schema:
            keys = schema["properties"]
            told = [f"`{key}`: {_joined(one['description'])}" for key, one in keys.items() if "description" in one]
            summary = _joined(schema.get("description", "").partition("\n\n")[0])
            yield f"`{name}`", ", ".join(f"`{key}`" for key in keys), "; ".join([summary, *told])


def proto_table(block: str, head: Row) -> Iterator[Row]:
    """The messages or enums of the .proto files, with their comments."""
    yield head
    for path in PROTO_FILES:
        for kind, name, body in _BLOCK.findall(path.read_text(encoding="utf-8")):
            if kind == block:
                lines = [
                    f"`{line.replace('google.protobuf.', '')}`{f' ({comment})' if comment else ''}"
                    for line, comment in _DECLARATION.findall(body)
                ]
                yield f"`{name}`", ", ".join(lines)


def _default(item: Field[Any]) -> str:
    if item.default_factory is not MISSING:
        return json.dumps(to_dict(item.default_factory()))
    return "required" if item.default is MISSING else json.dumps(to_dict(item.default))


def _described(item: Field[Any]) -> str:
    limits = limits_in_words(item)
    return ". ".join(part for part in (_joined(item.metadata.get("description", "")), limits) if part)


def _meaning(thing: object) -> str:
    """The first paragraph of a docstring."""
    return _joined((inspect.getdoc(thing) or "").partition("\n\n")[0])


def _joined(text: str) -> str:
    return " ".join(text.split()).removesuffix(".")


def client_error_table() -> list[Row]:
    """The errors of the client, in their order there."""
    rows = ((cls.reason, cls.__name__, cls.__mro__[1].__name__) for cls in client_errors.ERRORS)
    return [("Reason", "Class", "Kind of"), *([f"`{cell}`" for cell in row] for row in rows)]


def client_contract_table() -> list[Row]:
    """The classes that the client has from the library, and the sets that they form."""
    table: list[Row] = [("Name in `ultragray_client`", "Meaning")]
    for name in client_contract.__all__:
        thing = getattr(client_contract, name)
        if not isinstance(thing, type):
            members = ", ".join(f"`{member.__name__}`" for member in get_args(thing))
            table.append((f"`{name}`", f"Any of {members}"))
        elif issubclass(thing, Enum):
            table.append((f"`{name}`", f"{_meaning(thing)}: {', '.join(f'`{member.name}`' for member in thing)}"))
        else:
            table.append((f"`{_call(thing)}`", _meaning(thing)))
    return table


def _call(cls: type) -> str:
    """`Name(field, with=default)` of a dataclass, but for the `kind` that tells a member of a family apart."""
    given = inspect.signature(cls).parameters.values()
    parameters = [one.replace(annotation=one.empty) for one in given if one.name != "kind" or one.default is one.empty]
    text = str(inspect.Signature(parameters)).replace("<factory>", "…")
    return cls.__name__ + re.sub(r"<(\w+\.\w+): [^>]*>", r"\1", text)


def settings_table() -> list[Row]:
    """The settings of the service, by their environment variables."""
    table: list[Row] = [("Variable", "Default", "Limits", "Meaning")]
    for item, _ in annotated_fields(Settings):
        default = "" if item.default in (None, ()) else f"`{item.default}`"
        choices = ", ".join(f"`{word}`" for word in item.metadata.get("choices", ()))
        meaning = str(item.metadata["description"])
        table.append(
            (f"`{ENVIRONMENT_PREFIX}{item.name.upper()}`", default, choices or range_of(item).strip(), meaning)
        )
    return table


def format_table() -> list[Row]:
    """The formats of exported frames."""
    rows = (
        (
            f"`{one.name}`",
            f"`{one.suffix}`",
            ", ".join(f"`{dtype}`" for dtype in one.dtypes),
            "" if one.extra is None else f"`{one.extra}`",
            one.meaning,
        )
        for one in FORMATS.values()
    )
    return [("Format", "Suffix", "Pixels, the default first", "Extra", "Holds"), *rows]


def command_table() -> list[Row]:
    """The commands of `ultragray`, as its `--help` lists them."""
    found = typer.main.get_command(command_line).commands  # type: ignore[attr-defined]
    rows = ((f"`{name}`", " ".join(command.help.split())) for name, command in found.items())
    return [("Command", "Meaning"), *rows]


def commands() -> Iterator[tuple[str, Any]]:
    """Every command of `ultragray` that does something itself, by its words."""
    waiting = list(typer.main.get_command(command_line).commands.items())  # type: ignore[attr-defined]
    while waiting:
        name, command = waiting.pop(0)
        if hasattr(command, "commands"):
            waiting += [(f"{name} {word}", inner) for word, inner in command.commands.items()]
        else:
            yield name, command


def option_table(command: Any) -> list[Row]:
    """The arguments and options of a command, as its `--help` explains them."""
    table: list[Row] = [("Argument, option", "Meaning")]
    for parameter in command.params:
        is_argument = parameter.param_type_name == "argument"
        names = [parameter.name.upper()] if is_argument else parameter.opts
        meaning = str(parameter.help or "").replace("|", "\\|")
        if parameter.envvar:
            meaning += f" [{parameter.envvar}]"
        if parameter.required and not is_argument:
            meaning += " Required."
        elif isinstance(parameter.show_default, str):
            meaning += f" Default: {parameter.show_default}."
        elif parameter.show_default and parameter.default not in (None, False):
            meaning += f" Default: {getattr(parameter.default, 'value', parameter.default)}."
        table.append((", ".join(f"`{name}`" for name in names), meaning))
    return table


def npz_table() -> Table:
    """The arrays of an .npz archive."""
    yield "Key", "Type", "Shape", "Meaning"
    for output in OUTPUTS.values():
        yield f"`{output.name}`", f"`{output.dtype.name}`", "`[C, H, W]`", "Only where it was asked for"
    yield "`poses`", "`float64`", "`[C, 4, 4]`", "As used, mm"
    for figure in FIGURES:
        yield f"`{figure}`", "`float32`", "`[C]`", "See [confidence](#confidence); NaN: not known"
    yield "`scene`", "`str`", "`[]`", "Name of the scene"
    yield "`scene_sha256`", "`str`", "`[]`", "SHA-256 of the scene file"
    yield "`renderer`", "`str`", "`[]`", "Name, version, backend, such as `ultragray/0.1.0 cpu-avx512`"


TABLES: dict[str, Callable[[], Table]] = {
    "errors": error_table,
    "outputs": output_table,
    "npz": npz_table,
    "render_body": partial(field_table, RenderBody, "Key"),
    "display": partial(field_table, Display, "Setting"),
    "confidence": partial(told_table, Extrapolation, "Figure"),
    "stream_messages": partial(field_table, StreamMessage, "Key"),
    "stream_settings": partial(field_table, RenderSettings, "Key"),
    "stream_frames": partial(told_table, FrameMessage, "Key"),
    "objects": object_table,
    "messages": partial(proto_table, "message", ("Message", "Fields")),
    "enums": partial(proto_table, "enum", ("Enum", "Values")),
    "client_contract": client_contract_table,
    "client_errors": client_error_table,
    "settings": settings_table,
    "commands": command_table,
    "formats": format_table,
    **{f"options of {name}": partial(option_table, command) for name, command in commands()},
}


if __name__ == "__main__":
    DOCUMENT.write_text(generated(DOCUMENT.read_text(encoding="utf-8")), encoding="utf-8")
