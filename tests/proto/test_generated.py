"""The committed stubs are those that proto/generate.py makes of the .proto files."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from types import ModuleType

import pytest
from google.protobuf.descriptor_pb2 import DescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from grpc_tools import protoc

from ultragray_proto.v1 import (
    access_pb2,
    datasets_pb2,
    geometry_pb2,
    jobs_pb2,
    registrations_pb2,
    rendering_pb2,
    scenes_pb2,
    workers_pb2,
)

from ..scripts import loaded

PROTO = Path(__file__).resolve().parents[2] / "proto"
COMMITTED = PROTO / "ultragray_proto" / "v1"
VERSION_LINE = "# Protobuf Python Version: "


@pytest.fixture(scope="module")
def generator() -> ModuleType:
    return loaded(PROTO / "generate.py")


def protoc_version(folder: Path) -> str:
    lines = (folder / "rendering_pb2.py").read_text().splitlines()
    return next(line for line in lines if line.startswith(VERSION_LINE))


def clear_json_names(message: DescriptorProto) -> None:
    """protoc writes them out where the stubs leave the default."""
    for field in message.field:
        field.ClearField("json_name")
    for nested in message.nested_type:
        clear_json_names(nested)


def test_stubs_are_current(generator: ModuleType, tmp_path: Path) -> None:
    generated = {path.name: path.read_text() for path in generator.generate(tmp_path)}
    if protoc_version(tmp_path) != protoc_version(COMMITTED):
        pytest.skip("another release of grpcio-tools: the texts differ, test_descriptors_are_current compares")
    committed = {path.name: path.read_text() for path in COMMITTED.glob("*_pb2*.py*") if path.is_file()}
    assert committed == generated


def test_descriptors_are_current(tmp_path: Path) -> None:
    output = tmp_path / "descriptors"
    sources = sorted(str(path) for path in (PROTO / "ultragray" / "v1").glob("*.proto"))
    folders = (f"-I{PROTO}", f"-I{files('grpc_tools') / '_proto'}")
    assert protoc.main(["protoc", *folders, "--include_imports", f"--descriptor_set_out={output}", *sources]) == 0
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(output.read_bytes()).file:  # dependencies come first
        pool.AddSerializedFile(file.SerializeToString())
    modules = (
        geometry_pb2,
        scenes_pb2,
        rendering_pb2,
        access_pb2,
        datasets_pb2,
        jobs_pb2,
        workers_pb2,
        registrations_pb2,
    )
    assert len(modules) == len(sources)
    for module in modules:
        committed, expected = FileDescriptorProto(), FileDescriptorProto()
        module.DESCRIPTOR.CopyToProto(committed)
        pool.FindFileByName(module.DESCRIPTOR.name).CopyToProto(expected)
        for message in (*committed.message_type, *expected.message_type):
            clear_json_names(message)
        assert committed == expected


def test_stubs_do_not_import_the_model_library() -> None:
    for path in COMMITTED.glob("*_pb2*"):
        assert "from ultragray." not in path.read_text()
