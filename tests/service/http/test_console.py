"""The page at /: its headers, its files, and what is there before it was built."""

import asyncio

import httpx
import pytest
from fastapi import FastAPI

from ultragray_service.http.app import add_console

KEY = "0123456789abcdef-console"


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "console"


@pytest.fixture
def package(tmp_path):
    return tmp_path / "package"


@pytest.fixture
def page(folder, package):
    app = FastAPI()
    add_console(app, folder, package)
    return httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://test")


def build(folder):
    (folder / "assets").mkdir(parents=True)
    (folder / "index.html").write_text("<!doctype html><title>console</title>")
    (folder / "favicon.svg").write_text("<svg/>")
    (folder / "licences.txt").write_text("MIT")
    (folder / "assets" / "index-1a2b.js").write_text("export {};" * 1000)


def get(page, path, **headers):
    return asyncio.run(page.get(path, headers={name.replace("_", "-"): value for name, value in headers.items()}))


def test_before_it_is_built_a_page_says_how(page):
    answer = get(page, "/")
    assert answer.status_code == 200
    assert "make console" in answer.text
    assert 'href="/docs"' in answer.text
    assert get(page, "/assets/index-1a2b.js").status_code == 404


def test_the_page_is_asked_for_again_and_its_files_are_kept(page, folder):
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
    assert get(page, "/licences.txt").text == "MIT"


def test_the_renderer_of_pages_is_asked_for_again_and_compiles_webassembly_in_its_worker_alone(page, package):
    assert get(page, "/package/worker.js").status_code == 404
    package.mkdir()
    (package / "worker.js").write_text("export {};")
    (package / "ultragray.wasm").write_bytes(bytes(5000))
    worker = get(page, "/package/worker.js")
    assert worker.headers["cache-control"] == "no-cache"
    assert "script-src 'self' 'wasm-unsafe-eval';" in worker.headers["content-security-policy"]
    assert get(page, "/package/worker.js", if_none_match=worker.headers["etag"]).status_code == 304
    assert get(page, "/package/ultragray.wasm").headers["content-type"] == "application/wasm"


@pytest.mark.parametrize("path", ["/assets/%2e%2e/index.html", "/assets/%2e%2e%2findex.html"])
def test_only_assets_lie_below_assets(page, folder, path):
    build(folder)
    assert get(page, path).request.url.raw_path == path.encode()
    assert get(page, path).status_code == 404


@pytest.mark.parametrize("path", ["/", "/favicon.svg"])
def test_what_did_not_change_is_not_sent_again(page, folder, path):
    build(folder)
    tag = get(page, path).headers["etag"]
    for known in (tag, f"W/{tag}", f'"other", {tag}'):
        again = get(page, path, if_none_match=known)
        assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", tag)
        assert again.headers["cache-control"] == "no-cache"
    (folder / "index.html").write_text("<!doctype html><title>newer</title>")
    (folder / "favicon.svg").write_text("<svg></svg>")
    changed = get(page, path, if_none_match=tag)
    assert changed.status_code == 200
    assert changed.headers["etag"] != tag


def test_the_policy_lets_nothing_foreign_in(page):
    headers = get(page, "/").headers
    policy = dict(part.split(" ", 1) for part in headers["content-security-policy"].split("; "))
    assert policy["default-src"] == "'self'"
    assert policy["frame-ancestors"] == "'none'"
    assert policy["script-src"] == "'self' 'wasm-unsafe-eval'"
    assert headers["content-security-policy"].count("unsafe") == 1
    assert headers["x-content-type-options"] == "nosniff"


@pytest.mark.parametrize(
    ("host", "sockets"),
    [
        ("scan.example:8000", " ws://scan.example:8000 wss://scan.example:8000"),
        ("[::1]:8000", " ws://[::1]:8000 wss://[::1]:8000"),
        ("evil.example; script-src *", ""),
        ("a,b", ""),
    ],
)
def test_the_policy_names_the_sockets_of_its_host(page, host, sockets):
    policy = get(page, "/", host=host).headers["content-security-policy"]
    assert policy.endswith(f"; connect-src 'self'{sockets}")
