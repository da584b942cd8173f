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
    """Each command that does something itself, with its arguments, options and examples, by the panels of `--help`."""
    panels: dict[str, list[tuple[str, str]]] = {}
    for panel, name, command in all_commands():
        panels.setdefault(panel, []).append((f"ultragray {name}", _command(name, command)))
    return sections(2, ((panel, sections(3, those)) for panel, those in panels.items()))


def all_commands() -> Iterator[tuple[str, str, Any]]:
    """Every command that does something itself, by its panel and its words, in the order of `--help`."""

    def below(panel: str, prefix: str, group: Any) -> Iterator[tuple[str, str, Any]]:
        for word, command in group.commands.items():
            inside = panel or getattr(command, "rich_help_panel", None) or "Commands"
            if hasattr(command, "commands"):
                yield from below(inside, f"{prefix}{word} ", command)
            elif not command.hidden:
                yield inside, f"{prefix}{word}", command

    return below("", "", typer.main.get_command(app))


def _command(name: str, command: Any) -> str:
    shown = [parameter for parameter in command.params if not getattr(parameter, "hidden", False)]
    arguments = [_metavar(one) for one in shown if one.param_type_name == "argument"]
    usage = " ".join(("ultragray", name, *arguments, *(["[OPTIONS]"] if len(shown) > len(arguments) else [])))
    panels: dict[str, list[Any]] = {}
    for parameter in shown:
        usual = "Arguments" if parameter.param_type_name == "argument" else "Options"
        panels.setdefault(getattr(parameter, "rich_help_panel", None) or usual, []).append(parameter)
    tables = [table((panel, "Default", "Meaning"), map(_parameter, those)) for panel, those in panels.items()]
    parts = (f"```text\n{usage}\n```", prose(_plain(command.help or "")), *tables, _epilogue(command.epilog or ""))
    return "\n\n".join(part for part in parts if part)


def _epilogue(text: str) -> str:
    """Examples as one block; what else there is as words."""
    lines = [line for line in _plain(text).splitlines() if line.strip() and line != "Examples"]
    examples = [line for line in lines if "ultragray " in line or line.startswith("#")]
    block = "\n".join(("```bash", *examples, "```")) if examples else ""
    return "\n\n".join(part for part in (block, *(prose(line) for line in lines if line not in examples)) if part)


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
