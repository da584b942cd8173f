"""Writes the tables of docs/interfaces.md that follow from the code: `python docs/generate.py`, or `make generate`.

Such a table stands between `<!-- generated: NAME -->` and `<!-- end -->`, and TABLES says what makes it.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterable, Iterator
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any, get_args

import typer

from ultragray import errors
from ultragray.contract import annotated_fields, range_of
from ultragray_client import contract as client_contract
from ultragray_client import errors as client_errors
from ultragray_service import errors as service_errors
from ultragray_service.cli.app import app as command_line
from ultragray_service.errors import statuses_of
from ultragray_service.settings import ENVIRONMENT_PREFIX, Settings
from ultragray_workers import errors as workers_errors

DOCUMENT = Path(__file__).resolve().parent / "interfaces.md"
_GENERATED = re.compile(r"(?<=<!-- generated: )([\w -]+?)( -->\n).*?(?=<!-- end -->)", flags=re.DOTALL)

Row = Iterable[str]


def generated(document: str) -> str:
    """The document with its tables as the code has them now."""
    return _GENERATED.sub(lambda match: f"{match[1]}{match[2]}{_table(*TABLES[match[1]]())}", document)


def _table(head: Row, *rows: Row) -> str:
    first = f"| {' | '.join(head)} |\n{'|---' * len(list(head))}|\n"
    return first + "".join(f"| {' | '.join(row)} |\n" for row in rows)


def error_table() -> list[Row]:
    """The errors of each module, in their order there."""
    table: list[Row] = [("Reason", "Class", "In", "HTTP", "gRPC", "Meaning")]
    for module in (errors, workers_errors, service_errors):
        for cls in errors.error_classes():
            if cls.__module__ == module.__name__:
                arrow = "↳ " if cls.__base__ is errors.InvalidArgument else ""
                statuses = statuses_of(cls)
                table.append(
                    (
                        f"`{cls.reason}`",
                        f"{arrow}`{cls.__name__}`",
                        f"`{module.__name__}`",
                        str(statuses.http),
                        statuses.grpc,
                        _meaning(cls),
                    )
                )
    return table


def _meaning(thing: object) -> str:
    """The first paragraph of a docstring."""
    return " ".join((inspect.getdoc(thing) or "").partition("\n\n")[0].split()).removesuffix(".")


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


TABLES: dict[str, Callable[[], list[Row]]] = {
    "errors": error_table,
    "client_contract": client_contract_table,
    "client_errors": client_error_table,
    "settings": settings_table,
    "commands": command_table,
    **{f"options of {name}": partial(option_table, command) for name, command in commands()},
}


if __name__ == "__main__":
    DOCUMENT.write_text(generated(DOCUMENT.read_text(encoding="utf-8")), encoding="utf-8")
