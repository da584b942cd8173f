"""The gRPC interface, as docs/interfaces.md lists it."""

from __future__ import annotations

from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto

from ultragray.errors import error_classes
from ultragray_proto.v1 import access_pb2, datasets_pb2, geometry_pb2, jobs_pb2, rendering_pb2, scenes_pb2, workers_pb2
from ultragray_service import rpc
from ultragray_service.rpc import status

from .document import code, headers_read, table

PROTO_MODULES = (geometry_pb2, rendering_pb2, scenes_pb2, access_pb2, datasets_pb2, jobs_pb2, workers_pb2)


def declarations(message: DescriptorProto) -> list[str]:
    """The fields of a message as a .proto file writes them."""
    maps = {entry.name: entry for entry in message.nested_type if entry.options.map_entry}
    written = []
    for field in message.field:
        kind = type_name(field)
        label = "optional " if field.proto3_optional else ""
        if kind in maps:
            kind = f"map<{', '.join(type_name(part) for part in maps[kind].field)}>"
        elif field.label == FieldDescriptorProto.LABEL_REPEATED:
            label = "repeated "
        written.append(f"{label}{kind} {field.name} = {field.number}")
    return written


def type_name(field: FieldDescriptorProto) -> str:
    return field.type_name.rpartition(".")[2] or FieldDescriptorProto.Type.Name(field.type).lower()[len("type_") :]


def test_messages() -> None:
    found = {}
    for module in PROTO_MODULES:
        for name, descriptor in module.DESCRIPTOR.message_types_by_name.items():
            message = DescriptorProto()
            descriptor.CopyToProto(message)
            found[name] = declarations(message)
    documented = {name: [one for one in code(cell) if " = " in one] for name, (cell,) in table("Messages").items()}
    assert documented == found


def test_enums() -> None:
    found = {
        name: [f"{value.name} = {value.number}" for value in enum.values]
        for module in PROTO_MODULES
        for name, enum in module.DESCRIPTOR.enum_types_by_name.items()
    }
    assert {name: code(values) for name, (values,) in table("Enums").items()} == found


def test_methods() -> None:
    def side(name: str, streaming: bool) -> str:
        return f"stream {name}" if streaming else name

    found = {
        f"{service.name}.{method.name}": (
            side(method.input_type.name, method.client_streaming),
            side(method.output_type.name, method.server_streaming),
        )
        for module in PROTO_MODULES
        for service in module.DESCRIPTOR.services_by_name.values()
        for method in service.methods
    }
    assert {name: (code(taken)[0], code(given)[0]) for name, (taken, given) in table("Methods").items()} == found


def test_error_details() -> None:
    told = [status.status_of(cls("no", field="x")) for cls in error_classes()]
    found = {detail.type_url.rpartition("/")[2] for one in told for detail in one.details}
    assert set(table("Error details")) == found


def test_call_metadata() -> None:
    assert set(table("Call metadata")) == headers_read(rpc)
