"""Writes contract.hpp, the settings of frames and what they hold as C++ structures: `python model/library/generate.py`.

A dataclass becomes a structure of the same fields, with its defaults and a `read` that checks each by its limits
(`read_object` of document.hpp reads the whole); a family becomes a variant, so that a member without its case does not
compile. What fields mean together is checked by `check`, by hand (checks.cpp).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import MISSING, Field
from enum import Enum
from pathlib import Path
from types import NoneType
from typing import Any, get_args, get_origin

from ultragray.contract import Family, annotated_fields, optional_of
from ultragray.geometry.probe import ElevationBeam, Probe
from ultragray.rendering.display import Display
from ultragray.rendering.settings import RenderSettings
from ultragray.rendering.tools import Tool
from ultragray.scene.modes import Breathing
from ultragray.scene.speckle import SpeckleModel

TARGET = Path(__file__).with_name("contract.hpp")
CLASSES: tuple[Any, ...] = (ElevationBeam, Probe, Display, Tool, SpeckleModel, Breathing, RenderSettings)
_HEAD = """// Written by generate.py from the contract's dataclasses: `make generate` writes it anew.
// clang-format off
#pragma once

#include <variant>

#include "document.hpp"

namespace ultragray::library {

"""


def contract() -> str:
    parts: list[str] = []
    enums: dict[str, type[Enum]] = {}
    for cls in CLASSES:
        members = list(cls.members.values()) if issubclass(cls, Family) else [cls]
        for member in members:
            for _, annotation in annotated_fields(member):
                kind, _ = optional_of(annotation)
                if isinstance(kind, type) and issubclass(kind, Enum) and kind.__name__ not in enums:
                    enums[kind.__name__] = kind
                    parts.append(_enum(kind))
            parts.append(_structure(member))
        if issubclass(cls, Family):
            parts.append(_variant(cls))
    return _HEAD + "\n".join(parts) + "}  // namespace ultragray::library\n"


def _enum(kind: type[Enum]) -> str:
    words = ", ".join(f'"{one.value}"' for one in kind)
    names = ", ".join(_title(one.value) for one in kind)
    return (
        f"enum class {kind.__name__} {{ {names} }};\n"
        f"inline {kind.__name__} read_{kind.__name__}(const Value& value) {{ "
        f"return static_cast<{kind.__name__}>(value.word({{{words}}})); }}\n"
    )


def _title(word: str) -> str:
    return "".join(part.capitalize() for part in word.split("_"))


def _fields_of(cls: Any) -> Iterator[tuple[Field[Any], Any]]:
    return ((item, annotation) for item, annotation in annotated_fields(cls) if item.name != "kind")


def _structure(cls: Any) -> str:
    declared, read = [], []
    for item, annotation in _fields_of(cls):
        kind, optional = optional_of(annotation)
        type_name = _type(kind)
        default = None if item.default is MISSING else item.default
        whole = f"std::optional<{type_name}>" if optional else type_name
        declared.append(f"    {whole} {item.name}{_default(kind, default, optional)};")
        how = "require" if item.default is MISSING and item.default_factory is MISSING else "read"
        value = _reading(kind, item)
        read.append(f'        fields.{how}("{item.name}", [&](const Value& value) {{ {item.name} = {value}; }});')
    title = f"the {_family(cls)} {cls.kind}" if _family(cls) else cls.__name__
    fixed = [
        f"    static constexpr double {name} = {getattr(cls, name)};"
        for name in ("near_mm", "face_depth_mm")
        if isinstance(getattr(cls, name, None), float) and name not in {item.name for item, _ in _fields_of(cls)}
    ]
    lines = [
        f"struct {cls.__name__} {{",
        f'    static constexpr const char* title = "{title}";',
        *fixed,
        *declared,
        "    void read(Fields& fields) {",
        *read,
        "    }",
        "};",
        f"void check(const {cls.__name__}& it, const Value& value);",
        "",
    ]
    return "\n".join(lines)


def _family(cls: Any) -> str | None:
    family = next((one for one in cls.__mro__ if Family in one.__bases__), None)
    return None if family is None else family.__name__.lower()


def _variant(cls: Any) -> str:
    names = [member.__name__ for member in cls.members.values()]
    kinds = ", ".join(f'"{kind}"' for kind in cls.members)
    cases = [f"        case {place}: return read_object<{name}>(value);" for place, name in enumerate(names[:-1])]
    lines = [
        f"using {cls.__name__} = std::variant<{', '.join(names)}>;",
        f"inline {cls.__name__} read_{cls.__name__}(const Value& value) {{",
        *_named(cls),
        '    if (!value.json().is_object() || !value.json().contains("kind"))',
        f'        value.refuse("an object with a kind, one of {", ".join(cls.members)}");',
        f'    switch (value.at("kind").word({{{kinds}}})) {{',
        *cases,
        f"        default: return read_object<{names[-1]}>(value);",
        "    }",
        "}",
        "",
    ]
    return "\n".join(lines)


def _named(cls: Any) -> Iterator[str]:
    """The members that have a name, which stands for their JSON."""
    for name, member in cls.named.items():
        values = ", ".join(_literal(getattr(member, item.name)) for item, _ in _fields_of(type(member)))
        yield f'    if (value.json() == "{name}") return {type(member).__name__}{{{values}}};'


def _type(kind: Any) -> str:
    if get_origin(kind) is tuple:
        elements = get_args(kind)
        if Ellipsis in elements:
            return f"std::vector<{_type(elements[0])}>"
        return f"std::array<double, {len(elements)}>"
    plain = {float: "double", int: "int64_t", bool: "bool", str: "std::string"}
    return plain.get(kind, kind.__name__)


def _default(kind: Any, default: Any, optional: bool) -> str:
    if default is None or (optional and default is NoneType) or default == ():
        return "" if optional or kind not in (float, int, bool) else "{}"
    return f" = {_literal(default)}"


def _literal(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Enum):
        return f"{type(value).__name__}::{_title(value.value)}"
    if isinstance(value, tuple):
        return f"{{{', '.join(map(_literal, value))}}}"
    return f'"{value}"' if isinstance(value, str) else repr(value)


def _reading(kind: Any, item: Field[Any]) -> str:
    """The expression that takes a field from `value`."""
    limit_of = item.metadata.get
    numbers = [(name, limit_of(name)) for name in ("low", "high", "above")]
    limits = ", ".join("{}" if limit is None else repr(float(limit)) for _, limit in numbers)
    limits = "{" + limits + "}" if any(limit is not None for _, limit in numbers) else "{}"
    most = "{}" if limit_of("most") is None else str(limit_of("most"))
    if get_origin(kind) is tuple:
        element = get_args(kind)[0]
        if Ellipsis not in get_args(kind):
            return f"value.vector<{len(get_args(kind))}>({limits})"
        if element is float:
            return f"value.numbers({limits}, {most})"
        return f"read_list<{_type(element)}>(value, {most}, [](const Value& value) {{ return {_element(element)}; }})"
    if kind in (float, int):
        return f"value.{'number' if kind is float else 'integer'}({limits})"
    if kind is bool:
        return "value.flag()"
    return _element(kind)


def _element(kind: Any) -> str:
    if kind is str:
        return "value.text()"
    if issubclass(kind, Enum) or (issubclass(kind, Family) and Family in kind.__bases__):
        return f"read_{kind.__name__}(value)"
    return f"read_object<{kind.__name__}>(value)"


if __name__ == "__main__":
    TARGET.write_text(contract(), encoding="utf-8")
