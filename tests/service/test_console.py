"""The page at /: its headers, its files, and what is there before it was built."""

from __future__ import annotations

import asyncio
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI

from ultragray_service.http.console import CONSOLE_FOLDER, add_console

from .conftest import StartService

KEY = "0123456789abcdef-console"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "console"


@pytest.fixture
def page(folder: Path) -> httpx.AsyncClient:
    app = FastAPI()
    add_console(app, folder)
    return httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://test")


def build(folder: Path) -> None:
    (folder / "assets").mkdir(parents=True)
    (folder / "index.html").write_text("<!doctype html><title>console</title>")
    (folder / "favicon.svg").write_text("<svg/>")
    (folder / "assets" / "index-1a2b.js").write_text("export {};" * 1000)


def get(page: httpx.AsyncClient, path: str) -> httpx.Response:
    return asyncio.run(page.get(path))


def test_before_it_is_built_a_page_says_how(page: httpx.AsyncClient) -> None:
    answer = get(page, "/")
    assert answer.status_code == 200
    assert "make console" in answer.text
    assert 'href="/docs"' in answer.text
    assert get(page, "/assets/index-1a2b.js").status_code == 404


def test_the_page_is_asked_for_again_and_its_files_are_kept(page: httpx.AsyncClient, folder: Path) -> None:
    build(folder)
    answer = get(page, "/")
    assert "<title>console</title>" in answer.text
    assert answer.headers["cache-control"] == "no-cache"
    script = get(page, "/assets/index-1a2b.js")
    assert script.headers["content-type"].startswith("text/javascript")
    assert "immutable" in script.headers["cache-control"]
    assert script.headers["x-content-type-options"] == "nosniff"
    assert script.headers["content-encoding"] == "gzip"
    assert script.text == "export {};" * 1000
    assert get(page, "/favicon.svg").headers["content-type"] == "image/svg+xml"
    assert get(page, "/assets/../index.html").status_code == 404


def test_the_policy_lets_nothing_foreign_in(page: httpx.AsyncClient) -> None:
    headers = get(page, "/").headers
    policy = dict(part.split(" ", 1) for part in headers["content-security-policy"].split("; "))
    assert policy["default-src"] == "'self'"
    assert policy["frame-ancestors"] == "'none'"
    assert "unsafe" not in headers["content-security-policy"]
    assert headers["x-content-type-options"] == "nosniff"


def test_a_service_with_keys_serves_the_page_to_everyone(start_service: StartService) -> None:
    with httpx.Client(base_url=start_service(api_keys=KEY).http) as http:
        assert http.get("/").status_code == 200
        assert http.get("/assets/none.js").status_code == 404
        assert http.get("/v1/statistics").status_code == 401
        assert http.get("/favicon.svg").status_code == (200 if CONSOLE_FOLDER.is_dir() else 404)
