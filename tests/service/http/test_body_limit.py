"""The limit of bodies that come in chunks, of which nobody knows the length before."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from ultragray_service.errors import BodyTooLarge
from ultragray_service.http.middleware import LimitBody


def test_a_body_in_chunks_is_refused_at_the_chunk_that_exceeds_the_limit() -> None:
    read: list[bytes] = []

    async def receive() -> Any:
        return {"type": "http.request", "body": b"123456", "more_body": True}

    async def app(scope: Any, receive: Any, send: Any) -> None:
        while len(read) < 100:
            read.append((await receive())["body"])

    async def send(message: Any) -> None: ...

    scope = {"type": "http", "method": "POST", "path": "/v1/jobs", "headers": [(b"transfer-encoding", b"chunked")]}
    with pytest.raises(BodyTooLarge):
        asyncio.run(LimitBody(app, limit_bytes=15)(scope, receive, send))
    assert len(read) == 2
