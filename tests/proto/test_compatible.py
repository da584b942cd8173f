"""The gRPC contract only grows: what contract.txt lists is still there, with its number and its type.

Additions pass, and are listed by ULTRAGRAY_UPDATE_SNAPSHOTS=1 pytest tests/proto/test_compatible.py. A line that goes
or changes breaks programs that were built before: a field that is wanted no more is reserved, and a new one is added.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    EnumDescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
)

CONTRACT = Path(__file__).with_name("contract.txt")
PROTO = Path(__file__).resolve().parents[2] / "proto" / "ultragray" / "v1"


def contract_of(file: FileDescriptorProto) -> Iterator[str]:
    """Every field, enum value and method of a file, a line each."""
    for message in file.message_type:
        yield from _message(f"{file.package}.{message.name}", message)
    for enum in file.enum_type:
        yield from _enum(f"{file.package}.{enum.name}", enum)
    for service in file.service:
        for method in service.method:
            taken = "stream " * method.client_streaming + method.input_type[1:]
            given = "stream " * method.server_streaming + method.output_type[1:]
            yield f"{file.package}.{service.name}.{method.name}({taken}) returns ({given})"


def _message(name: str, message: DescriptorProto) -> Iterator[str]:
    for field in message.field:
        kind = field.type_name[1:] or FieldDescriptorProto.Type.Name(field.type).lower().removeprefix("type_")
        label = (
            "repeated " if field.label == FieldDescriptorProto.LABEL_REPEATED else "optional " * field.proto3_optional
        )
        inside = ""
        if field.HasField("oneof_index") and not field.proto3_optional:
            inside = f" (oneof {message.oneof_decl[field.oneof_index].name})"
        yield f"{name}.{field.name} = {field.number}: {label}{kind}{inside}"
    for nested in message.nested_type:
        yield from _message(f"{name}.{nested.name}", nested)
    for enum in message.enum_type:
        yield from _enum(f"{name}.{enum.name}", enum)


def _enum(name: str, enum: EnumDescriptorProto) -> Iterator[str]:
    return (f"{name}.{value.name} = {value.number}" for value in enum.value)


def current() -> list[str]:
    found: list[str] = []
    for path in sorted(PROTO.glob("*.proto")):
        file = FileDescriptorProto()
        import_module(f"ultragray_proto.v1.{path.stem}_pb2").DESCRIPTOR.CopyToProto(file)
        found += contract_of(file)
    return found


def broken(before: list[str], now: list[str]) -> list[str]:
    return [line for line in before if line not in set(now)]


def test_the_contract_only_grows() -> None:
    now = current()
    if os.environ.get("ULTRAGRAY_UPDATE_SNAPSHOTS") == "1":
        CONTRACT.write_text("\n".join(now) + "\n", encoding="utf-8")
    gone = broken(CONTRACT.read_text(encoding="utf-8").splitlines(), now)
    assert not gone, "the contract no longer has:\n" + "\n".join(gone)


def a_file() -> FileDescriptorProto:
    file = FileDescriptorProto(package="p")
    message = file.message_type.add(name="M")
    message.field.add(name="a", number=1, type="TYPE_DOUBLE", label="LABEL_OPTIONAL")
    message.field.add(name="b", number=2, type="TYPE_INT32", label="LABEL_REPEATED")
    file.enum_type.add(name="E").value.add(name="X", number=0)
    file.service.add(name="S").method.add(name="Do", input_type=".p.M", output_type=".p.M")
    return file


def _add(file: FileDescriptorProto) -> None:
    file.message_type[0].field.add(name="c", number=3, type="TYPE_STRING", label="LABEL_OPTIONAL")
    file.message_type.add(name="New")
    file.enum_type[0].value.add(name="Y", number=1)


def test_additions_pass() -> None:
    before, after = a_file(), a_file()
    _add(after)
    assert not broken(list(contract_of(before)), list(contract_of(after)))


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda file: file.message_type[0].field.pop(0), "p.M.a = 1: double"),
        (lambda file: setattr(file.message_type[0].field[0], "number", 7), "p.M.a = 1: double"),
        (lambda file: setattr(file.message_type[0].field[0], "name", "z"), "p.M.a = 1: double"),
        (lambda file: setattr(file.message_type[0].field[0], "type", 2), "p.M.a = 1: double"),
        (lambda file: setattr(file.message_type[0].field[1], "label", 1), "p.M.b = 2: repeated int32"),
        (lambda file: setattr(file.enum_type[0].value[0], "number", 5), "p.E.X = 0"),
        (lambda file: setattr(file.service[0].method[0], "server_streaming", True), "p.S.Do(p.M) returns (p.M)"),
    ],
)
def test_changes_are_found(change: object, line: str) -> None:
    before, after = a_file(), a_file()
    change(after)  # type: ignore[operator]
    assert broken(list(contract_of(before)), list(contract_of(after))) == [line]
