"""Parts about Python: public names with their signatures and docstrings."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from dataclasses import is_dataclass
from enum import Enum
from importlib import import_module
from types import ModuleType, UnionType
from typing import Any, Union, get_args, get_origin

from ultragray.contract import Contract

from . import library
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
    *("ultragray_client.sync.scenes.Scenes", "ultragray_client.sync.datasets.Datasets"),
    *("ultragray_client.sync.jobs.Jobs", "ultragray_client.sync.workers.Workers"),
    "ultragray_client.sync.registrations.Registrations",
)
_ONLY = {"ultragray.contract": ("from_dict", "to_dict")}
_OWN = ("ultragray", "ultragray_client")


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
    return sorted(
        name
        for name, value in vars(module).items()
        if not name.startswith("_")
        and name not in above
        and (inspect.isfunction(value) or inspect.isclass(value))
        and value.__module__ == module.__name__
    )


def snapshot() -> str:
    """Every public name with its signature, a line each."""
    lines: list[str] = []
    for name in ("ultragray", *LIBRARY_MODULES, "ultragray_client"):
        module = import_module(name)
        for short in exported(module):
            lines += _lines(f"{name}.{short}", getattr(module, short))
    for path in CLIENT_GROUPS:
        module_name, _, short = path.rpartition(".")
        lines += _lines(path, getattr(import_module(module_name), short))
    return "\n".join(lines) + "\n"


def _lines(name: str, value: Any) -> Iterator[str]:
    yield f"{name}{signature(value)}"
    if inspect.isclass(value) and not issubclass(value, Enum):
        for member, inner in members(value):
            yield f"{name}.{member}{signature(inner)}"


def signature(value: Any) -> str:
    """`(parameters) -> answer` of what can be called; what else a name is, after a colon."""
    if inspect.ismodule(value):
        return ": a module"
    if inspect.isclass(value) and issubclass(value, Enum):
        return f": {', '.join(f'{one.name} = {one.value!r}' for one in value)}"
    if isinstance(value, property):
        told = inspect.signature(value.fget).return_annotation if value.fget else inspect.Signature.empty
        return "" if told is inspect.Signature.empty else f": {told}"
    if get_origin(value) in (Union, UnionType) and all(map(_is_own, get_args(value))):
        return f": any of {', '.join(one.__name__ for one in get_args(value))}"
    if isinstance(value, (int, float, str, Contract)):
        return f" = {value!r}"
    if not (inspect.isroutine(value) or inspect.isclass(value)):
        return ""
    return str(_readable(inspect.signature(value), is_class=inspect.isclass(value)))


class _Word:
    """A word that is written into a signature as it is."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __repr__(self) -> str:
        return self.text


def _readable(found: inspect.Signature, *, is_class: bool) -> inspect.Signature:
    """Without `self` and the `kind` that tells the members of a family apart; annotations as they are written."""
    kept = []
    for one in found.parameters.values():
        if one.name == "self" or (one.name == "kind" and "Literal" in str(one.annotation)):
            continue
        default = one.default
        if isinstance(default, Enum):
            default = _Word(f"{type(default).__name__}.{default.name}")
        elif repr(default) == "<factory>" or inspect.isroutine(default):
            default = _Word("…")
        kept.append(one.replace(annotation=_written(one.annotation), default=default))
    told = inspect.Signature.empty if is_class else _written(found.return_annotation)
    return inspect.Signature(kept, return_annotation=told)


def _written(annotation: Any) -> Any:
    return _Word(annotation) if isinstance(annotation, str) else annotation


def members(cls: type[Any]) -> Iterator[tuple[str, Any]]:
    """Public methods and properties that our own code defines, by name; those of a public base are told there."""
    found: dict[str, Any] = {}
    public = [Contract, *(base for base in cls.__mro__[1:] if _is_public(base))]
    for base in reversed(cls.__mro__):
        if _is_own(base) and not any(base in one.__mro__ for one in public):
            for name, value in vars(base).items():
                if name.startswith("_") or inspect.isclass(value):
                    continue
                if isinstance(value, (staticmethod, classmethod)):
                    found[name] = getattr(cls, name)
                elif inspect.isfunction(value) or isinstance(value, property):
                    found[name] = value
    return iter(sorted(found.items()))


def _is_own(cls: Any) -> bool:
    return inspect.isclass(cls) and cls.__module__.partition(".")[0] in _OWN


def _is_public(cls: type[Any]) -> bool:
    module = import_module(cls.__module__.partition(".")[0])
    return getattr(module, cls.__name__, None) is cls


def _documented(value: Any) -> str:
    name = value.__name__ if inspect.isclass(value) or inspect.isroutine(value) else ""
    told = f"{name}{signature(value)}".removeprefix(": ").removeprefix(" = ")
    parts = [f"```text\n{told}\n```"] if told else []
    if name or inspect.ismodule(value):
        parts.append(prose(inspect.getdoc(value) or ""))
    if isinstance(value, type) and not issubclass(value, Enum):
        if is_dataclass(value) and issubclass(value, Contract):
            parts.append(library.keys(value, "Field"))
        parts += (f"`{name}{signature(inner)}`{_indented(inner)}" for name, inner in members(value))
    return "\n\n".join(part for part in parts if part)


def _indented(value: Any) -> str:
    """The docstring of a member as the definition of its name."""
    words = prose(inspect.getdoc(value) or "").replace("\n", "\n    ")
    return f"\n: {words}" if words else ""
