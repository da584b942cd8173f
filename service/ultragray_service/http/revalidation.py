"""Answers that a client keeps and asks about: sent again only where they changed."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from starlette.requests import Request
from starlette.responses import Response

NOT_MODIFIED = "It is as the client has it (If-None-Match)."


async def revalidated(request: Request, version: str, make: Callable[[], Awaitable[Response]]) -> Response:
    """What `make` answers, with `version` as its ETag; 304 without asking it where the client has that version.

    `version` names the content: letters, digits and '-'. A Cache-Control of the answer stays.
    """
    tag = f'"{version}"'
    known = [known.strip().removeprefix("W/") for known in request.headers.get("if-none-match", "").split(",")]
    answer = Response(status_code=304) if tag in known else await make()
    answer.headers["ETag"] = tag
    answer.headers.setdefault("Cache-Control", "private, no-cache")
    return answer
