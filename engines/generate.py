"""Writes csharp/Contract.cs, what programs in C# send to a service and get from it: `python engines/generate.py`.

A dataclass becomes a class of the same fields with their defaults, which writes itself as JSON where it is sent, and
reads itself where it comes back; a family becomes a base class with its members, an enum an enum.

Unity wants a file `.meta` beside each file of a package, with a number that stays: they are written here, too.
"""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Iterator
from dataclasses import MISSING, is_dataclass
from enum import Enum
from html import escape
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from ultragray.contract import Family, annotated_fields, optional_of
from ultragray.rendering.settings import FrameSettings, RenderSettings
from ultragray_service.core.scenes import Scene, ScenePage
from ultragray_service.http.routes.streams import FrameMessage, RefusalMessage

FOLDER = Path(__file__).parent
TARGET = FOLDER / "csharp" / "Contract.cs"
SENT: tuple[Any, ...] = (FrameSettings, RenderSettings)
RECEIVED: tuple[Any, ...] = (FrameMessage, RefusalMessage, Scene, ScenePage)
# Words that mean something else to a C# programmer, or in Unity.
NAMES = {"FrameMessage": "FrameHeader", "Scene": "SceneDetails", "Bounds": "SceneBounds", "Display": "DisplaySettings"}
NAMES |= {"Quaternion": "Rotation", "Encoding": "PixelEncoding", "PoseInBothForms": "TrainingPose"}
PLAIN = {float: "double", int: "long", bool: "bool", str: "string"}
READ = {"double": "Number()", "long": "Integer()", "bool": "Flag()"}
LISTS = {"double": "Numbers", "double[]": "Rows", "string": "Texts"}
HEAD = """// Written by engines/generate.py from the contract's dataclasses: `make generate` writes it anew.
using System;
using System.Collections.Generic;

namespace Ultragray
{
"""


def contract() -> str:
    sent, received = _reachable(SENT), _reachable(RECEIVED)
    found = list(dict.fromkeys((*sent, *received)))
    enums = [one for one in found if issubclass(one, Enum)]
    words = [f"internal static readonly string[] {_name(one)} = {{ {_words(one)} }};" for one in enums]
    parts = [_block(["/// <summary>The words of each enum in JSON.</summary>"], "static class Words", words)]
    for cls in found:
        if issubclass(cls, Enum):
            members = ", ".join(_title(one.value) for one in cls)
            parts.append(_block(_summary(cls.__doc__), f"public enum {_name(cls)}", [members]))
        elif Family in cls.__bases__:
            parts.append(_family(cls))
        else:
            parts.append(_class(cls, is_sent=cls in sent, is_received=cls in received))
    return HEAD + "\n\n".join(parts) + "\n}\n"


def _reachable(roots: tuple[Any, ...]) -> list[Any]:
    """The classes that the roots are made of, each after those that it is made of."""
    found: list[Any] = []

    def visit(kind: Any) -> None:
        for part in get_args(kind):
            visit(part)
        is_class = isinstance(kind, type) and (issubclass(kind, (Enum, Family)) or is_dataclass(kind))
        if not is_class or kind in found:
            return
        if issubclass(kind, Family) and Family in kind.__bases__:
            found.append(kind)
            for member in kind.members.values():
                visit(member)
            return
        if not issubclass(kind, Enum):
            for _, annotation in annotated_fields(kind):
                visit(annotation)
        found.append(kind)

    for root in roots:
        visit(root)
    return found


def _class(cls: Any, *, is_sent: bool, is_received: bool) -> str:
    base = next((one for one in cls.__mro__[1:] if one in SENT or Family in one.__bases__), None)
    family = base is not None and issubclass(base, Family)
    inherited = {item.name for item, _ in annotated_fields(base)} if base in SENT else {"kind"}
    fields = [(item, kind) for item, kind in annotated_fields(cls) if item.name not in inherited]
    is_base = any(cls in other.__mro__[1:] for other in SENT)
    bodies = [line for item, kind in fields for line in _property(item, kind)]
    override = "override " if family else ""
    if family:
        bodies += [f'public override string Kind => "{cls.kind}";']
    written = [_written(item.name, kind) for item, kind in fields]
    if is_base:
        bodies += _method(f"internal void Write{_name(cls)}(JsonWriter json)", written)
    elif is_sent:
        first = ['json.Member("kind", Kind);'] if family else []
        first += [f"Write{_name(base)}(json);"] if base in SENT else []
        body = ["json.Open('{');", *first, *written, "json.Close('}');"]
        bodies += _method(f"public {override}void Write(JsonWriter json)", body)
    if is_received:
        cases = [
            f'if (json.Named("{item.name}")) {_title(item.name)} = {_read(item.name, kind)};' for item, kind in fields
        ]
        body = ["if (!json.Enter('{')) return;", "while (json.NextMember())", "{"]
        body += [f"    {'else ' if place else ''}{case}" for place, case in enumerate(cases)]
        bodies += _method(f"public {override}void Read(JsonReader json)", [*body, "    else json.Skip();", "}"])
    if cls is RECEIVED[0]:
        bodies += _names_by_form(fields)
    bases = [_name(base)] if base else []
    bases += ["IWritable"] * (is_sent and not is_base and not family) + ["IReadable"] * (is_received and not family)
    head = f"public {'' if is_base else 'sealed '}class {_name(cls)}{' : ' * bool(bases)}{', '.join(bases)}"
    return _block(_summary(cls.__doc__), head, bodies)


def _names_by_form(fields: Any) -> list[str]:
    """The members by how headers of HTTP tell them: as a text, with commas, or as JSON."""
    forms: dict[str, list[str]] = {"Texts": [], "TextLists": [], "Others": []}
    for item, kind in fields:
        whole, _ = optional_of(kind)
        is_text = whole is str or (isinstance(whole, type) and issubclass(whole, Enum))
        forms["Texts" if is_text else "TextLists" if _type(whole) == "string[]" else "Others"].append(f'"{item.name}"')
    return [f"internal static readonly string[] {form} = {{ {', '.join(names)} }};" for form, names in forms.items()]


def _family(cls: Any) -> str:
    name = _name(cls)
    cases = [f'    case "{kind}": return new {member.__name__}();' for kind, member in cls.members.items()]
    known = ["if (json.IsNull()) return null;", 'string kind = json.PeekText("kind", current?.Kind);']
    known += [
        "var it = current != null && current.Kind == kind ? current : Make(kind);",
        "it.Read(json);",
        "return it;",
    ]
    bodies = ["public abstract string Kind { get; }", "public abstract void Write(JsonWriter json);"]
    bodies += ["public abstract void Read(JsonReader json);"]
    bodies += [f"internal static readonly Func<JsonReader, {name}, {name}> ReadOne = Read;"]
    bodies += _method(f"internal static {name} Read(JsonReader json, {name} current)", known)
    fall = '    default: throw new FormatException("'
    fall += f'this client knows no {name.lower()} of the kind " + kind);'
    bodies += _method(f"static {name} Make(string kind)", ["switch (kind)", "{", *cases, fall, "}"])
    return _block(_summary(cls.__doc__), f"public abstract class {name} : IWritable, IReadable", bodies)


def _type(kind: Any) -> str:
    """The C# type of what an annotation holds beside None."""
    if get_origin(kind) is Literal:
        return "string"
    if get_origin(kind) in (list, tuple):
        return f"{_type(get_args(kind)[0])}[]"
    if get_origin(kind) is dict:
        return f"Dictionary<string, {_type(get_args(kind)[1])}>"
    return PLAIN.get(kind) or _name(kind)


def _property(item: Any, annotation: Any) -> Iterator[str]:
    kind, optional = optional_of(annotation)
    is_value = kind in (float, int, bool) or (isinstance(kind, type) and issubclass(kind, Enum))
    default = item.default
    if isinstance(default, bool):
        value = f" = {str(default).lower()};" if default else ""
    elif isinstance(default, Enum):
        value = f" = {_name(type(default))}.{_title(default.value)};"
    elif isinstance(default, tuple) and default:
        value = f" = {{ {', '.join(map(repr, default))} }};".replace("'", '"')
    else:
        value = f" = {default!r};" if isinstance(default, (int, float)) and default else ""
    if default is MISSING and kind is str and not optional:
        value = ""
    yield from _summary(item.metadata.get("description"))
    yield f"public {_type(kind)}{'?' * (optional and is_value)} {_title(item.name)} {{ get; set; }}{value}"


def _written(name: str, annotation: Any) -> str:
    kind, optional = optional_of(annotation)
    value = _title(name)
    if isinstance(kind, type) and issubclass(kind, Enum):
        word = f"Words.{_name(kind)}[(int){value}{'.Value' * optional}]"
        value = f"{value} == null ? null : {word}" if optional else word
    return f'json.Member("{name}", {value});'


def _read(name: str, annotation: Any) -> str:
    kind, optional = optional_of(annotation)
    current, held = _title(name), _type(kind)
    if isinstance(kind, type) and issubclass(kind, Enum):
        word = f"({held}{'?' * optional})json.Word(Words.{_name(kind)})"
        return f"json.IsNull() ? null : {word}" if optional else word
    if held in READ:
        return f"json.{READ[held].replace('()', 'OrNull()' if optional else '()')}"
    if held == "string":
        return f"json.Text({current})"
    if get_origin(kind) is dict:
        return f"json.Map(JsonReader.{'ReadNumber' if held.endswith('double>') else 'ReadText'})"
    if held.endswith("[]"):
        element = get_args(kind)[0]
        if held[:-2] in LISTS:
            return f"json.{LISTS[held[:-2]]}({current})"
        return f"json.Elements({current}, {held[:-2]}.ReadOne)" if _is_family(element) else f"json.Objects({current})"
    return f"{held}.Read(json, {current})" if _is_family(kind) else f"json.Object({current})"


def _is_family(kind: Any) -> bool:
    return issubclass(kind, Family) and Family in kind.__bases__


def _name(cls: Any) -> str:
    return NAMES.get(cls.__name__, cls.__name__)


def _title(word: str) -> str:
    return "".join(part[:1].upper() + part[1:] for part in word.split("_"))


def _words(cls: Any) -> str:
    return ", ".join(f'"{one.value}"' for one in cls)


def _summary(text: str | None) -> list[str]:
    first = " ".join(inspect.cleandoc(text or "").split("\n\n")[0].split())
    return [f"/// <summary>{escape(first, quote=False)}</summary>"] if first else []


def _method(head: str, body: list[str]) -> list[str]:
    return [head, "{", *(f"    {line}" for line in body), "}"]


def _block(summary: list[str], head: str, body: list[str]) -> str:
    lines = [*summary, head, "{", *(f"    {line}" for line in body), "}"]
    return "\n".join(f"    {line}" for line in lines)


def metas() -> dict[Path, str]:
    """What Unity keeps beside each file and folder of a package; folders that end with ~ are none of Unity's."""
    packages = (FOLDER / "csharp", FOLDER / "unity")
    files = (path for package in packages for path in package.rglob("*") if "~" not in str(path.relative_to(FOLDER)))
    return {path.with_name(f"{path.name}.meta"): _meta(path) for path in files if path.suffix != ".meta"}


def _meta(path: Path) -> str:
    number = hashlib.md5(path.relative_to(FOLDER).as_posix().encode(), usedforsecurity=False).hexdigest()
    return f"fileFormatVersion: 2\nguid: {number}\n"


if __name__ == "__main__":
    TARGET.write_text(contract(), encoding="utf-8")
    for path, text in metas().items():
        path.write_text(text, encoding="utf-8")
