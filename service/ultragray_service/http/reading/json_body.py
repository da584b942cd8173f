"""JSON bodies, read as the classes of the contract."""

from __future__ import annotations

from functools import cache
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError
from starlette.requests import Request

from ultragray_service.errors import UnsupportedMediaType
from ultragray_service.http.problems import invalid_argument
from ultragray_service.http.reading.large_json import INLINE_BYTES, Apart, read_large

T = TypeVar("T")


@cache
def adapter_of(cls: Any) -> TypeAdapter[Any]:
    """The reader and writer of a class's JSON."""
    return TypeAdapter(cls)


def body_schema(cls: Any, examples: dict[str, Any] | None = None) -> dict[str, Any]:
    """The part of the OpenAPI document about a body that a route reads by itself."""
    content: dict[str, Any] = {"schema": {"$ref": f"#/components/schemas/{cls.__name__}"}}
    if examples is not None:
        content["examples"] = examples
    return {"requestBody": {"required": True, "content": {"application/json": content}}}


async def read_json_body(request: Request, cls: type[T], apart: Apart | None = None) -> T:
    """The body, checked; `apart` says which part of it may be large.

    Raises UnsupportedMediaType, BodyTooLarge, InvalidArgument and what the class raises.
    """
    content_type = request.headers.get("content-type", "application/json")
    media_type = content_type.partition(";")[0].strip().lower()
    if media_type != "application/json" and not media_type.endswith("+json"):
        raise UnsupportedMediaType(f"Content-Type must be application/json, got {content_type!r}", field="Content-Type")
    if request.headers.get("content-encoding", "identity").lower() != "identity":
        raise UnsupportedMediaType("the body must not be compressed", field="Content-Encoding")
    body = await request.body()
    return read_json(body, cls) if len(body) <= INLINE_BYTES else await read_large(body, cls, apart, read_json)


def read_json(text: str | bytes, cls: type[T]) -> T:
    """The value of a JSON text. Raises InvalidArgument, and what the class raises."""
    try:
        kind: Any = cls
        value: T = adapter_of(kind).validate_json(text)
    except ValidationError as error:
        raise invalid_argument(error.errors(include_url=False)[0], cls) from None
    return value
