"""Artifacts are answered in ranges, as a web server answers files."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Route

from ultragray_service.http.routes.jobs import SHOWN, artifact_response
from ultragray_workers.jobs.files import Artifact
from ultragray_workers.jobs.record import StoredFile
from ultragray_workers.storage.local import LocalStorage

CONTENT = bytes(range(256)) * 10_000


Get = Callable[..., httpx.Response]


@pytest.fixture
def get(tmp_path: Path) -> Get:
    """Answers the same file from a storage and from a folder."""
    storage = LocalStorage(tmp_path)
    storage.write("jobs/one/frames.npz", CONTENT)
    file = Artifact(storage, "frames.npz", StoredFile("jobs/one/frames.npz", len(CONTENT), "ab" * 32))

    async def shared(request: Request) -> Response:
        return artifact_response(file, request.headers, "application/x-npz", "attachment")

    async def local(request: Request) -> Response:
        path = tmp_path / "jobs" / "one" / "frames.npz"
        return FileResponse(path, media_type="application/x-npz", filename="frames.npz", headers=SHOWN)

    app = Starlette(routes=[Route("/shared", shared), Route("/local", local)])

    def get(path: str, headers: dict[str, str] | None = None) -> httpx.Response:
        async def ask() -> httpx.Response:
            async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://test") as client:
                return await client.get(path, headers=headers)

        return asyncio.run(ask())

    return get


@pytest.mark.parametrize(
    "asked",
    ["", "bytes=0-", "bytes=100-", "bytes=100-199", "bytes=-5", "bytes=2559999-", "bytes=2560000-", "bytes=5-99999999"],
)
def test_a_range_is_answered_as_of_a_file(get: Get, asked: str) -> None:
    headers = {"Range": asked} if asked else {}
    shared, local = get("/shared", headers=headers), get("/local", headers=headers)
    assert shared.status_code == local.status_code
    if local.status_code != 416:
        assert shared.content == local.content
        for name in ("content-length", "content-range", "content-type", "accept-ranges", *SHOWN):
            assert shared.headers.get(name) == local.headers.get(name), name


def test_a_download_of_another_content_begins_anew(get: Get) -> None:
    etag = get("/shared").headers["etag"]
    same = get("/shared", headers={"Range": "bytes=10-", "If-Range": etag})
    assert (same.status_code, len(same.content)) == (206, len(CONTENT) - 10)
    other = get("/shared", headers={"Range": "bytes=10-", "If-Range": '"of another"'})
    assert (other.status_code, other.content) == (200, CONTENT)
