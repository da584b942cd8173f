"""The public interface, pinned.

After a wanted change: ULTRAGRAY_UPDATE_SNAPSHOTS=1 pytest tests/service/test_snapshots.py, and read the difference.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import httpx
from google.protobuf.descriptor import Descriptor, FileDescriptor
from pydantic import TypeAdapter

from ultragray_proto.v1 import access_pb2, datasets_pb2, geometry_pb2, jobs_pb2, rendering_pb2, scenes_pb2, workers_pb2
from ultragray_service.errors import STATUSES
from ultragray_service.settings import Settings

FOLDER = Path(__file__).parent / "snapshots"
OPENAPI = Path(__file__).parents[2] / "web/openapi.json"  # what the console's types and lists are generated from
WORDS_ONLY = {"description", "title", "summary", "examples", "example", "operationId"}


def check(path: Path, current: Any) -> None:
    text = json.dumps(current, indent=1, sort_keys=path != OPENAPI, ensure_ascii=False) + "\n"
    if os.environ.get("ULTRAGRAY_UPDATE_SNAPSHOTS") == "1":
        path.write_text(text)
    assert json.loads(path.read_text()) == json.loads(text), f"the public interface differs from {path}"


def without_words(value: Any, *, named: bool = False) -> Any:
    """`value` without prose; the keys of a `named` mapping are names, not keywords."""
    if isinstance(value, dict):
        return {
            key: without_words(item, named=key in ("properties", "schemas", "paths", "headers", "responses"))
            for key, item in value.items()
            if named or key not in WORDS_ONLY
        }
    if isinstance(value, list):
        return [without_words(item) for item in value]
    return value


def test_http(http: httpx.Client) -> None:
    check(OPENAPI, http.get("/openapi.json").json())


def fields(message: Descriptor) -> dict[str, Any]:
    return {field.name: [field.number, field.type, bool(field.is_repeated)] for field in message.fields} | {
        nested.name: fields(nested) for nested in message.nested_types
    }


def contract(file: FileDescriptor) -> dict[str, Any]:
    return {
        "messages": {name: fields(message) for name, message in file.message_types_by_name.items()},
        "enums": {
            name: {value.name: value.number for value in enum.values} for name, enum in file.enum_types_by_name.items()
        },
        "services": {
            name: {
                method.name: {
                    "input": method.input_type.full_name,
                    "output": method.output_type.full_name,
                    "streams": [method.client_streaming, method.server_streaming],
                }
                for method in service.methods
            }
            for name, service in file.services_by_name.items()
        },
    }


def test_grpc() -> None:
    files = (geometry_pb2, scenes_pb2, rendering_pb2, access_pb2, datasets_pb2, jobs_pb2, workers_pb2)
    check(FOLDER / "proto.json", {module.DESCRIPTOR.name: contract(module.DESCRIPTOR) for module in files})


def test_reasons() -> None:
    table = {reason: {"http": statuses.http, "grpc": statuses.grpc} for reason, statuses in STATUSES.items()}
    check(FOLDER / "reasons.json", table)


def test_settings() -> None:
    schema = TypeAdapter(Settings).json_schema()
    check(FOLDER / "settings.json", without_words(schema["properties"], named=True))
