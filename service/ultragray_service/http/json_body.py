"""Reading a JSON body by its model."""

from __future__ import annotations

from typing import TypeVar

from pydantic import BaseModel, ValidationError
from starlette.requests import Request

from ..errors import UnsupportedMediaType
from .problems import invalid_argument

Model = TypeVar("Model", bound=BaseModel)


async def read_json_body(request: Request, model: type[Model]) -> Model:
    """The body, each field of the right type. Raises UnsupportedMediaType, BodyTooLarge, InvalidArgument."""
    content_type = request.headers.get("content-type", "application/json")
    media_type = content_type.partition(";")[0].strip().lower()
    if media_type != "application/json" and not media_type.endswith("+json"):
        raise UnsupportedMediaType(f"Content-Type must be application/json, got {content_type!r}", field="Content-Type")
    if request.headers.get("content-encoding", "identity").lower() != "identity":
        raise UnsupportedMediaType("the body must not be compressed", field="Content-Encoding")
    try:
        return model.model_validate_json(await request.body())
    except ValidationError as error:
        raise invalid_argument(error.errors(include_url=False)[0]) from None
