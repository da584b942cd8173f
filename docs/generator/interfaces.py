"""Parts about the interfaces: HTTP from the OpenAPI document, gRPC from the .proto files."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from ultragray_service.http.app import create_app
from ultragray_service.service import Service
from ultragray_service.settings import Settings
from ultragray_service.wiring import make_service

from .markdown import code, codes, in_line, prose, sections, table

FILES = sorted((Path(__file__).resolve().parents[2] / "proto" / "ultragray" / "v1").glob("*.proto"))


@contextmanager
def temporary_service() -> Iterator[Service]:
    """A service that is never started, with an empty data folder."""
    with tempfile.TemporaryDirectory() as folder:
        yield make_service(Settings(data_folder=Path(folder)))


@cache
def document() -> dict[str, Any]:
    with temporary_service() as service:
        found: dict[str, Any] = create_app(service).openapi()
    return found


def routes() -> str:
    """Every operation, under the heading of its tag."""
    by_tag: dict[str, list[str]] = {}
    for path, operations in document()["paths"].items():
        for method, operation in operations.items():
            by_tag.setdefault(operation["tags"][0].capitalize(), []).append(_operation(method, path, operation))
    return sections(3, ((tag, "\n".join(texts)) for tag, texts in by_tag.items()))


def _operation(method: str, path: str, operation: dict[str, Any]) -> str:
    role = operation.get("x-role")
    facts = [f"*Role*: {role}{', of its owner' if operation['x-owned'] else ''}." if role else "*No key is needed.*"]
    body = operation.get("requestBody", {}).get("content", {})
    if body:
        facts.append(f"*Body*: {', '.join(_content(body))}.")
    for status, answer in operation["responses"].items():
        if int(status) >= 400:
            continue
        words = in_line(answer["description"]).replace("Successful Response", "")  # what the framework says of all
        holds = ", ".join(_content(answer.get("content", {})))
        facts.append(f"*{status}*: {'; '.join(filter(None, (holds, words))) or 'nothing'}.")
    facts.append(f"*Errors*: {', '.join(status for status in operation['responses'] if int(status) >= 400) or 'none'}.")
    rows = (
        (code(one["name"]), one["in"], _default(one["schema"]), _meaning(one))
        for one in operation.get("parameters", ())
        if one["in"] != "path"
    )
    return "\n".join(
        (
            f"#### {code(f'{method.upper()} {path}')}\n",
            f"{prose(operation.get('description') or operation['summary'])}\n",
            f"{' '.join(facts)}\n",
            table(("Parameter", "In", "Default", "Meaning"), rows),
        )
    )


def _content(content: dict[str, Any]) -> Iterator[str]:
    for media_type, what in content.items():
        schema = what.get("schema", {})
        yield _kind(schema) if "$ref" in schema else code(media_type)


def _default(schema: dict[str, Any]) -> str:
    return "" if schema.get("default") in (None, "") else code(schema["default"])


def _meaning(parameter: dict[str, Any]) -> str:
    words = in_line(parameter.get("description", ""))
    choices = codes(word for word in parameter["schema"].get("enum", ()) if word)
    return f"{words}. One of {choices}" if choices else words


def render_headers() -> str:
    """Headers of the answer with frames."""
    answer = document()["paths"]["/v1/scenes/{scene}/render"]["post"]["responses"]["200"]
    rows = ((code(name), in_line(header["description"])) for name, header in answer["headers"].items())
    return table(("Header", "Meaning"), rows)


def objects() -> str:
    """The schemas that have keys."""
    found = sorted(document()["components"]["schemas"].items())
    return sections(3, ((name, _object(schema)) for name, schema in found if "properties" in schema))


def _object(schema: dict[str, Any]) -> str:
    required = set(schema.get("required", ()))
    rows = (
        (code(key), _kind(one), "required" if key in required else _default(one), in_line(one.get("description", "")))
        for key, one in schema["properties"].items()
    )
    return f"{prose(schema.get('description', ''))}\n\n{table(('Key', 'Type', 'Default', 'Meaning'), rows)}"


def _kind(schema: dict[str, Any]) -> str:
    """The type of a value in words, with links to objects."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        is_object = "properties" in document()["components"]["schemas"][name]
        return f"[{code(name)}](#{name.lower()})" if is_object else _kind(document()["components"]["schemas"][name])
    for key in ("anyOf", "oneOf", "allOf"):
        if key in schema:
            return " or ".join(dict.fromkeys(map(_kind, schema[key])))
    if "enum" in schema:
        return " or ".join(code(word) for word in schema["enum"])
    if "const" in schema:
        return code(schema["const"])
    if schema.get("type") == "array":
        return f"list of {_kind(schema['items'])}" if schema.get("items") else "list"
    return str(schema.get("type", "any"))


def contract() -> str:
    """The .proto files, whose comments say what each message is for."""
    return sections(3, ((path.name, f"```proto\n{_without_origin(path)}```") for path in FILES))


def _without_origin(path: Path) -> str:
    """A .proto file without its first line, which names the template that it is written from."""
    return path.read_text(encoding="utf-8").partition("\n")[2]
