"""The command line, from the commands of `ultragray` themselves."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import typer

from ultragray_service.cli.app import app

from .markdown import code, in_line, prose, sections, table

_MARKUP = re.compile(r"\[/?(?:bold|dim|italic|red|green|blue|cyan|yellow|link[^\]]*)(?: [a-z ]+)?\]")

_VARIABLE = re.compile(r"\[(ULTRAGRAY_\w+)\]")


def commands() -> str:
    """Each command that does something itself, with its arguments, options and examples."""
    return sections(2, ((f"ultragray {name}", _command(name, command)) for name, command in all_commands()))


def all_commands() -> Iterator[tuple[str, Any]]:
    """Every command that does something itself, by its words, in the order of `--help`."""

    def below(prefix: str, group: Any) -> Iterator[tuple[str, Any]]:
        for word, command in group.commands.items():
            if hasattr(command, "commands"):
                yield from below(f"{prefix}{word} ", command)
            elif not command.hidden:
                yield f"{prefix}{word}", command

    return below("", typer.main.get_command(app))


def _command(name: str, command: Any) -> str:
    shown = [parameter for parameter in command.params if not getattr(parameter, "hidden", False)]
    arguments = [_metavar(one) for one in shown if one.param_type_name == "argument"]
    usage = " ".join(("ultragray", name, *arguments, *(["[OPTIONS]"] if len(shown) > len(arguments) else [])))
    panels: dict[str, list[Any]] = {}
    for parameter in shown:
        usual = "Arguments" if parameter.param_type_name == "argument" else "Options"
        panels.setdefault(getattr(parameter, "rich_help_panel", None) or usual, []).append(parameter)
    tables = [table((panel, "Default", "Meaning"), map(_parameter, those)) for panel, those in panels.items()]
    epilog = f"```text\n{_plain(command.epilog).strip()}\n```" if command.epilog else ""
    return "\n\n".join(
        part for part in (f"```text\n{usage}\n```", prose(_plain(command.help or "")), *tables, epilog) if part
    )


def _metavar(argument: Any) -> str:
    name = f"{argument.name.upper()}{'...' if argument.nargs != 1 else ''}"
    return name if argument.required else f"[{name}]"


def _plain(text: str) -> str:
    return _MARKUP.sub("", text).replace("\b", "").replace("\\[", "[")


def _parameter(parameter: Any) -> tuple[str, str, str]:
    is_argument = parameter.param_type_name == "argument"
    names = [parameter.name.upper()] if is_argument else [*parameter.opts, *parameter.secondary_opts]
    meaning = _VARIABLE.sub(r"`\1`", in_line(_plain(parameter.help or "")))
    if parameter.envvar and parameter.envvar not in meaning:
        meaning += f". {code(parameter.envvar)}"
    if parameter.required:
        default = "required"
    elif isinstance(parameter.show_default, str):
        default = code(parameter.show_default)
    elif parameter.show_default and parameter.default not in (None, False):
        default = code(getattr(parameter.default, "value", parameter.default))
    else:
        default = ""
    return ", ".join(map(code, names)), default, meaning
