"""Writes the gRPC contract: `python proto/generate.py`.

    templates/*.proto ─┐
    dataclasses ───────┼─▶ ultragray/v1/*.proto ─▶ protoc ─▶ ultragray_proto/v1 (stubs)
    numbers.txt ───────┘                              └────▶ numbers.txt, with what is new

A template is a .proto file by hand: services, requests and comments. Lines of it stand for what the code knows:

    // @fields module:Class but a b     in a message: the fields of a dataclass, or of all members of a family
    // @messages module:Family          a message for each member of a family that the template does not write itself
    // @members module:Family           in a oneof: a field for each member
    // @values module:name              in an enum: the values of an Enum, of a sequence of words, of a mapping by words

`numbers.txt` is the lock: each field, value and method that there ever was, with its number and its form. What is new
takes the next number and the form of its annotation; what is gone stays there and is reserved. A number or a form that
changes is an error.
"""

from __future__ import annotations

import inspect
import math
import re
import sys
import tempfile
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    EnumDescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from grpc_tools import protoc

from ultragray.contract import Family, limits_in_words, optional_of

ROOT = Path(__file__).resolve().parent
TEMPLATES, PROTOS, STUBS, LOCK = (
    ROOT / "templates",
    ROOT / "ultragray" / "v1",
    ROOT / "ultragray_proto" / "v1",
    "numbers.txt",
)
PACKAGE = "ultragray.v1"

_IMPORT = re.compile(r"^(\s*)from ultragray\.v1 import", flags=re.MULTILINE)
_BLOCK = re.compile(r"^(message|enum) (\w+) \{\n(.*?)^\}$", flags=re.MULTILINE | re.DOTALL)
_PRAGMA = re.compile(
    r"^( *)// @(fields|members|values|messages) ([\w.]+):(\w+)(?: but ([\w ]+))?\n", flags=re.MULTILINE
)
_DECLARED = re.compile(r"^ *(?:oneof (\w+) \{|[^/\n]*?(\w+) = \d+;)", flags=re.MULTILINE)
_LOCKED = re.compile(rf"{re.escape(PACKAGE)}\.([\w.]+)\.(\w+) = (\d+)(?:: (.+?))?(?: \(oneof (\w+)\))?")
_WIRE = {  # the forms that an annotation may have on the wire; a new field takes the first
    bool: ("bool",),
    int: ("int64", "int32", "uint64", "uint32"),
    float: ("double",),
    str: ("string",),
    bytes: ("bytes",),
}
_INT32 = 2**31
_WIDTH = 118


class ContractError(Exception):
    """A contract that the code and the lock do not agree on."""


class Lock:
    """The numbers that are taken, and the forms that go with them."""

    def __init__(self, lines: Iterable[str]) -> None:
        self.lines = list(lines)
        self.messages: dict[type, str] = {}  # and enums, of classes that have another name than theirs
        self.fields: dict[str, dict[str, tuple[int, str | None]]] = {}  # by message or enum, by name
        for line in self.lines:
            if (found := _LOCKED.fullmatch(line)) is not None:
                self.fields.setdefault(found[1], {})[found[2]] = int(found[3]), found[4]

    def number(self, owner: str, name: str, taken: Iterable[int] = ()) -> int:
        """The number of a field or value: its own, else the next one, which it then has."""
        known = self.fields.setdefault(owner, {})
        if name not in known:
            known[name] = max((0, *taken, *(number for number, _ in known.values()))) + 1, None
        return known[name][0]

    def form(self, owner: str, name: str) -> str | None:
        """The form of a field, such as `optional double`; None where it is new."""
        form = self.fields.get(owner, {}).get(name, (0, None))[1]
        if form is None:
            return None
        entry = self.fields.get(form.removeprefix(f"repeated {PACKAGE}."), {})
        if form.endswith("Entry") and {"key", "value"} == set(entry):
            return f"map<{_short(entry['key'][1])}, {_short(entry['value'][1])}>"
        return _short(form)

    def grown(self, current: list[str]) -> list[str]:
        """The lines, with those of the contract as it is now. Raises ContractError where a name has become another."""
        places = {_place(line): line for line in self.lines}
        changed = [f"{line}, was {places[_place(line)]}" for line in current if places.get(_place(line), line) != line]
        if changed:
            raise ContractError("the contract may only grow, but it now has:\n" + "\n".join(changed))
        return sorted({*self.lines, *current}, key=_sorting)


def _place(line: str) -> str:
    return re.split(r" = |\(", line, maxsplit=1)[0]


def _sorting(line: str) -> tuple[str, int, str]:
    found = _LOCKED.fullmatch(line)
    return (found[1], int(found[3]), line) if found else (line.rpartition(".")[0], 0, line)


def _short(form: str | None) -> str:
    return (form or "").replace(f"{PACKAGE}.", "")


def proto_text(template: str, lock: Lock) -> str:
    """The .proto file of a template. Raises ContractError."""
    written = {name for _, name, _ in _BLOCK.findall(template)}

    def block(match: re.Match[str]) -> str:
        kind, name, body = match.groups()
        declared = {one or other for one, other in _DECLARED.findall(body)}
        body = _PRAGMA.sub(lambda found: _PARTS[found[2]](found, name, declared, lock), body)
        return f"{kind} {name} {{\n{body}{_reserved(kind, name, body, lock)}}}"

    def messages(match: re.Match[str]) -> str:
        members = (one for one in _named(match).members.values() if one.__name__ not in written)
        parts = []
        for cls in members:
            own = "".join(_field_lines(cls, cls.__name__, set(), lock))
            own += _reserved("message", cls.__name__, own, lock)
            parts.append(f"{_comment(_about(cls))}message {cls.__name__} {{\n{own}}}\n")
        return "\n".join(parts)

    return _PRAGMA.sub(messages, _BLOCK.sub(block, template))


def _named(pragma: re.Match[str]) -> Any:
    return getattr(import_module(pragma[3]), pragma[4])


def _fields(pragma: re.Match[str], owner: str, declared: set[str], lock: Lock) -> str:
    return "".join(_field_lines(_named(pragma), owner, declared | set((pragma[5] or "").split()), lock))


def _members(pragma: re.Match[str], owner: str, declared: set[str], lock: Lock) -> str:
    indent, taken = pragma[1], [number for number, _ in lock.fields.get(owner, {}).values()]
    found = {lock.number(owner, kind, taken): (kind, cls.__name__) for kind, cls in _named(pragma).members.items()}
    return "".join(f"{indent}{name} {kind} = {number};\n" for number, (kind, name) in sorted(found.items()))


def _values(pragma: re.Match[str], owner: str, declared: set[str], lock: Lock) -> str:
    named, indent = _named(pragma), pragma[1]
    if isinstance(named, type) and issubclass(named, Enum):
        named = [one.value for one in named]
    prefix = re.sub(r"(?<!^)(?=[A-Z])", "_", owner).upper()
    found = {}
    for word in named:
        name = f"{prefix}_{word.upper()}"
        meaning = getattr(named[word], "about", "") if isinstance(named, Mapping) else ""
        found[lock.number(owner, name)] = _comment(meaning, indent) + f"{indent}{name} = "
    return "".join(f"{line}{number};\n" for number, line in sorted(found.items()))


_PARTS = {"fields": _fields, "members": _members, "values": _values}


def _field_lines(cls: Any, owner: str, declared: set[str], lock: Lock) -> list[str]:
    """The declarations of a class's fields, but for `declared`, in the order of their numbers."""
    found = {}
    for item, annotation in _fields_of(cls):
        if item.name in declared or item.name == "kind":
            continue
        form = lock.form(owner, item.name)
        if form is None:
            form = _form(owner, item, annotation, lock)
        else:
            _check_form(owner, item, annotation, form)
        number = lock.number(owner, item.name)
        found[number] = f"{_comment(_meaning(item, form), '  ')}  {form} {item.name} = {number};\n"
    return [found[number] for number in sorted(found)]


def _meaning(item: Field[Any], form: str) -> str:
    """What a field means, its limits, and what stands for it where it is left out."""
    limits, default = limits_in_words(item), item.default
    is_told = form.startswith("optional ") and default not in (MISSING, None)
    absent = f"Absent: {default.value if isinstance(default, Enum) else default}." if is_told else ""
    return " ".join(filter(None, [item.metadata.get("description", ""), limits and f"{limits}.", absent]))


def _fields_of(cls: Any) -> Iterator[tuple[Field[Any], Any]]:
    """The fields of a class, or those of all members of a family, each name once, with their annotations."""
    is_family = issubclass(cls, Family) and Family in cls.__bases__
    seen = set()
    for one in cls.members.values() if is_family else (cls,):
        hints = get_type_hints(one)
        for item in fields(one):
            if item.init and item.name not in seen:
                seen.add(item.name)
                yield item, hints[item.name]


def _form(owner: str, item: Field[Any], annotation: Any, lock: Lock) -> str:
    """The form of a new field by its annotation. Raises ContractError for one that has none."""
    kind, is_optional = optional_of(annotation)
    if get_origin(kind) in (tuple, list):
        return f"repeated {_wire_type(owner, item, get_args(kind)[0], lock)}"
    if get_origin(kind) is dict:
        return "map<{}, {}>".format(*(_wire_type(owner, item, one, lock) for one in get_args(kind)))
    wire = _wire_type(owner, item, kind, lock)
    is_message = is_dataclass(kind) or (isinstance(kind, type) and issubclass(kind, (Family, Enum)))
    has_presence = is_optional or (item.default is not MISSING and bool(item.default))
    return f"optional {wire}" if has_presence and not is_message else wire


def _wire_type(owner: str, item: Field[Any], kind: Any, lock: Lock) -> str:
    if kind is int and item.metadata.get("low", -math.inf) >= -_INT32 and item.metadata.get("high", math.inf) < _INT32:
        return "int32"
    if kind in _WIRE:
        return _WIRE[kind][0]
    if isinstance(kind, type) and (is_dataclass(kind) or issubclass(kind, (Enum, Family))):
        return lock.messages.get(kind, kind.__name__)
    raise ContractError(
        f"{owner}.{item.name} has no form on the wire: write it into the template, {kind} says too little"
    )


def _check_form(owner: str, item: Field[Any], annotation: Any, form: str) -> None:
    """Raises ContractError for a form that cannot hold what the annotation says."""
    kind, _ = optional_of(annotation)
    is_list = get_origin(kind) in (tuple, list)
    element = get_args(kind)[0] if is_list and get_args(kind) else kind
    words = form.split()
    scalars = {wire for forms in _WIRE.values() for wire in forms}
    if element in _WIRE and words[-1] in scalars and words[-1] not in _WIRE[element]:
        raise ContractError(f"{owner}.{item.name} is {form} on the wire, which cannot hold {item.type}")
    if not is_list and element in _WIRE and words[0] == "repeated":
        raise ContractError(f"{owner}.{item.name} is {form} on the wire, which cannot hold {item.type}")


def _reserved(kind: str, owner: str, body: str, lock: Lock) -> str:
    """What keeps the numbers and names of what is gone."""
    there = {one or other for one, other in _DECLARED.findall(body)}
    gone = {name: number for name, (number, _) in lock.fields.get(owner, {}).items() if name not in there}
    if not gone:
        return ""
    numbers = ", ".join(map(str, sorted(gone.values())))
    names = ", ".join(f'"{name}"' for name in sorted(gone))
    return f"  reserved {numbers};\n  reserved {names};\n"


def _about(cls: Any) -> str:
    """The docstring, but for the errors: what is refused is told with its field."""
    text = re.sub(r"\s*\bRaises\s.*?(?=\n\n|\Z)", "", inspect.cleandoc(cls.__doc__ or ""), flags=re.DOTALL)
    return text.replace("`", "").strip()


def _comment(text: str, indent: str = "") -> str:
    paragraphs = [" ".join(part.split()) for part in text.split("\n\n") if part.strip()]
    lines = f"\n{indent}//\n".join("\n".join(_wrapped(part, indent)) for part in paragraphs)
    return f"{lines}\n" if lines else ""


def _wrapped(text: str, indent: str) -> list[str]:
    return [f"{indent}// {line}" for line in textwrap.wrap(text, _WIDTH - len(indent), break_long_words=False)]


def generate(target: Path = ROOT) -> list[Path]:
    """Writes .proto files, stubs and the lock below a folder, and returns their paths.

    Raises ContractError where code and lock disagree, RuntimeError where protoc fails.
    """
    lock = Lock((ROOT / LOCK).read_text(encoding="utf-8").splitlines())
    protos, stubs = target / PROTOS.relative_to(ROOT), target / STUBS.relative_to(ROOT)
    templates = {path.name: path.read_text(encoding="utf-8") for path in sorted(TEMPLATES.glob("*.proto"))}
    for template in templates.values():
        for _, name, body in _BLOCK.findall(template):
            named = (_named(pragma) for pragma in _PRAGMA.finditer(body))
            lock.messages |= {one: name for one in named if isinstance(one, type)}
    written = []
    for name, template in templates.items():
        text = f"// Written by proto/generate.py from proto/templates/{name}; change that.\n"
        written.append(_write(protos / name, text + proto_text(template, lock)))
    with tempfile.TemporaryDirectory() as temporary:
        descriptors = Path(temporary, "descriptors")
        outputs = [f"--{name}_out={temporary}" for name in ("python", "pyi", "grpc_python")]
        folders = [f"-I{target}", f"-I{files('grpc_tools') / '_proto'}"]
        arguments = ["protoc", *folders, f"--descriptor_set_out={descriptors}", *outputs, *map(str, written)]
        if protoc.main(arguments) != 0:
            raise RuntimeError("protoc failed")
        current = contract_lines(FileDescriptorSet.FromString(descriptors.read_bytes()).file)
        for generated in sorted(Path(temporary, "ultragray", "v1").iterdir()):
            text = _IMPORT.sub(r"\1from ultragray_proto.v1 import", generated.read_text())
            if not generated.name.endswith("_pb2_grpc.py") or "class " in text:  # else a file of messages only
                written.append(_write(stubs / generated.name, text))
    written.append(_write(target / LOCK, "\n".join(lock.grown(current)) + "\n"))
    return written


def _write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def contract_lines(found: Iterable[FileDescriptorProto]) -> list[str]:
    """Every field, enum value and method of files, a line each, as the lock has them."""
    lines: list[str] = []
    for file in found:
        for message in file.message_type:
            lines += _message_lines(f"{file.package}.{message.name}", message)
        for enum in file.enum_type:
            lines += _enum_lines(f"{file.package}.{enum.name}", enum)
        for service in file.service:
            for method in service.method:
                taken = "stream " * method.client_streaming + method.input_type[1:]
                given = "stream " * method.server_streaming + method.output_type[1:]
                lines.append(f"{file.package}.{service.name}.{method.name}({taken}) returns ({given})")
    return lines


def _message_lines(name: str, message: DescriptorProto) -> Iterator[str]:
    for field in message.field:
        kind = field.type_name[1:] or FieldDescriptorProto.Type.Name(field.type).lower().removeprefix("type_")
        is_repeated = field.label == FieldDescriptorProto.LABEL_REPEATED
        label = "repeated " if is_repeated else "optional " * field.proto3_optional
        is_in_oneof = field.HasField("oneof_index") and not field.proto3_optional
        inside = f" (oneof {message.oneof_decl[field.oneof_index].name})" if is_in_oneof else ""
        yield f"{name}.{field.name} = {field.number}: {label}{kind}{inside}"
    for nested in message.nested_type:
        yield from _message_lines(f"{name}.{nested.name}", nested)
    for enum in message.enum_type:
        yield from _enum_lines(f"{name}.{enum.name}", enum)


def _enum_lines(name: str, enum: EnumDescriptorProto) -> Iterator[str]:
    return (f"{name}.{value.name} = {value.number}" for value in enum.value)


if __name__ == "__main__":
    try:
        generate()
    except ContractError as error:
        sys.exit(f"error: {error}")
