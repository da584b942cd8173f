"""Parts about Python and the command line: public names with their docstrings, commands as typer tells them."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from dataclasses import is_dataclass
from enum import Enum
from functools import cached_property
from importlib import import_module
from types import ModuleType
from typing import Any

import typer
from typer.cli import get_docs_for_click

from ultragray.contract import Contract
from ultragray_service.cli.app import app

from . import product
from .markdown import prose, sections

# Public modules beside the packages' own names. A module without __all__ makes public what it defines.
LIBRARY_MODULES = (
    "ultragray.datasets",
    "ultragray.datasets.source",
    "ultragray.datasets.released",
    "ultragray.datasets.plus",
    "ultragray.datasets.dicom",
    "ultragray.datasets.mcap",
    "ultragray.phantom",
    "ultragray.datasets.checks",
    "ultragray.datasets.pictures",
    "ultragray.learn.training",
    "ultragray.learn.evaluation.metrics",
    "ultragray.learn.evaluation.scoring",
    "ultragray.learn.evaluation.speckle",
    "ultragray.learn.evaluation.side_by_side",
    "ultragray.learn.evaluation.baselines",
    "ultragray.scene.confidence",
    "ultragray.rendering.contact",
    "ultragray_studies.gym",
    "ultragray.rendering.tools",
    "ultragray.rendering.volumes",
    "ultragray.rendering.volume_fields",
    "ultragray.samplers",
    "ultragray.contract",
    "ultragray.geometry.pose",
    "ultragray.rendering.frames",
    "ultragray.phantom.demo",
    "ultragray.rendering.display",
    "ultragray.geometry.scan_conversion",
    "ultragray.exchange.rendering",
    "ultragray.exchange.exports",
    "ultragray.exchange.exports.archives",
    "ultragray.exchange.ply",
    "ultragray.exchange.checkpoint",
    "ultragray.exchange.poses",
    "ultragray.files",
    "ultragray.geometry.registration",
    "ultragray.learn.registration",
)
CLIENT_GROUPS = (
    *("ultragray_client.client.Scenes", "ultragray_client.client.Datasets"),
    *("ultragray_client.client.Jobs", "ultragray_client.client.Workers"),
    "ultragray_client.client.Registrations",
)
_ONLY = {"ultragray.contract": ("from_dict", "to_dict")}

_HEADING = re.compile(r"\[bold\]")


def package(name: str) -> str:
    """The names that a package exports."""
    module = import_module(name)
    return sections(3, ((short, _documented(getattr(module, short))) for short in exported(module)))


def client_groups() -> str:
    """What the attributes of a client are, such as `client.jobs`."""
    found = (path.rpartition(".") for path in CLIENT_GROUPS)
    return sections(
        3, ((f"client.{name.lower()}", _documented(getattr(import_module(module), name))) for module, _, name in found)
    )


def modules() -> str:
    """The public modules of the library."""

    def parts() -> Iterator[tuple[str, str]]:
        for name in LIBRARY_MODULES:
            module = import_module(name)
            words = prose((inspect.getdoc(module) or "").partition("\n\n")[0])
            inner = sections(4, ((short, _documented(getattr(module, short))) for short in exported(module)))
            yield name, f"{words}\n\n{inner}"

    return sections(3, parts())


def exported(module: ModuleType) -> list[str]:
    """The public names of a module, those of its package left out."""
    if module.__name__ in _ONLY:
        return list(_ONLY[module.__name__])
    if hasattr(module, "__all__"):
        return sorted(module.__all__)
    above = set(getattr(import_module(module.__name__.partition(".")[0]), "__all__", ()))
    defined = {
        name
        for name, value in vars(module).items()
        if not name.startswith("_") and getattr(value, "__module__", None) == module.__name__ and callable(value)
    }
    return sorted(defined - above)


class _Word:
    """A word that is written into a signature as it is."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __repr__(self) -> str:
        return self.text


def signature(value: Any) -> str:
    """`(parameters) -> answer` of what can be called; the members of an enum, the type of a property; else nothing."""
    if isinstance(value, type) and issubclass(value, Enum):
        return f": {', '.join(f'{one.name} = {one.value!r}' for one in value)}"
    if isinstance(value, property):
        return f": {inspect.signature(value.fget).return_annotation}" if value.fget else ""
    if not (inspect.isroutine(value) or inspect.isclass(value)):
        return ""

    def written(annotation: Any) -> Any:
        return _Word(annotation) if isinstance(annotation, str) else annotation

    found = inspect.signature(value)
    dropped = ("self", "kind") if inspect.isclass(value) else ("self",)  # `kind` tells members of a family apart
    kept = [one for name, one in found.parameters.items() if name not in dropped]
    answer = found.empty if inspect.isclass(value) else written(found.return_annotation)
    return str(
        inspect.Signature([one.replace(annotation=written(one.annotation)) for one in kept], return_annotation=answer)
    )


def members(cls: type[Any]) -> Iterator[tuple[str, Any]]:
    """The public methods and properties that a class defines itself or has of private bases, by name."""
    own = [base for base in reversed(cls.__mro__) if base is cls or base.__name__.startswith("_")]
    for name in sorted({name for base in own for name in vars(base) if not name.startswith("_")}):
        value = getattr(cls, name)
        if isinstance(value, cached_property):
            value = property(value.func)
        if inspect.isroutine(value) or isinstance(value, property):
            yield name, value


def _documented(value: Any) -> str:
    name = value.__name__ if inspect.isclass(value) or inspect.isroutine(value) else ""
    told = f"{name}{signature(value)}".removeprefix(": ")
    parts = [f"```text\n{told}\n```"] if told else []
    if name or inspect.ismodule(value):
        parts.append(prose(inspect.getdoc(value) or ""))
    if isinstance(value, type) and not issubclass(value, Enum):
        if is_dataclass(value) and issubclass(value, Contract):
            parts.append(product.keys(value, "Field"))
        for short, inner in members(value):
            words = prose(inspect.getdoc(inner) or "").replace("\n", "\n    ")
            parts.append(f"`{name}.{short}{signature(inner)}`" + (f"\n: {words}" if words else ""))
    return "\n\n".join(part for part in parts if part)


def commands() -> str:
    """Each command that does something itself, by the panels of `--help`."""
    panels: dict[str, list[str]] = {}
    for panel, name, command in _commands(typer.main.get_command(app)):
        lines = [
            line.replace("\\[", "[")
            for line in (command.epilog or "").splitlines()
            if line.strip() and not _HEADING.search(line)
        ]
        command.epilog = None  # examples are a block of their own
        context = typer.Context(command, info_name=name)
        text = get_docs_for_click(obj=command, ctx=context, indent=2, name=name, call_prefix="ultragray")
        examples = "\n".join(("```bash", *lines, "```")) if lines else ""
        panels.setdefault(panel, []).append(f"{text}\n{examples}\n")
    return sections(2, ((panel, "\n".join(those)) for panel, those in panels.items()))


def _commands(group: Any, panel: str = "", prefix: str = "") -> Iterator[tuple[str, str, Any]]:
    """Every command that does something itself, by its panel and its words, in the order of `--help`."""
    for word, command in group.commands.items():
        inside = panel or getattr(command, "rich_help_panel", None) or "Commands"
        if hasattr(command, "commands"):
            yield from _commands(command, inside, f"{prefix}{word} ")
        elif not command.hidden:
            yield inside, f"{prefix}{word}", command
