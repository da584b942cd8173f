"""Slow uploads of one client leave room for those of others."""

from __future__ import annotations

import socket
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest

from ultragray_service.core.uploads import MAX_IMPORTS

from ...conftest import DEMO_PROBE, make_scene
from .conftest import Limited


def begin_import(limited: Limited, who: str, name: str) -> socket.socket:
    """Sends the beginning of a scene."""
    url = httpx.URL(limited.service.http)
    connection = socket.create_connection((url.host, url.port or 80), timeout=60)
    head = f"PUT /v1/scenes/{name} HTTP/1.1\r\nHost: localhost\r\nX-API-Key: {limited.keys[who]}\r\n"
    connection.sendall(f"{head}Expect: 100-continue\r\nContent-Length: 100000\r\n\r\n".encode())
    assert b"100 Continue" in connection.recv(4096)  # the body is being read
    connection.sendall(b"x")
    return connection


@pytest.mark.long
def test_slow_imports_of_one_key_keep_nobody_else_out(limited: Limited, tmp_path: Path) -> None:
    make_scene(30, probe=DEMO_PROBE).save(tmp_path / "scene.ugr")
    content = (tmp_path / "scene.ugr").read_bytes()
    with ExitStack() as stack:
        for number in range(MAX_IMPORTS // 2):
            stack.enter_context(begin_import(limited, "jobs", f"slow-{number}"))
        mine = limited.http("jobs", "PUT", "/v1/scenes/one-more", content=content)
        assert (mine.status_code, mine.json()["reason"]) == (429, "QUEUE_FULL")
        assert "of this client" in mine.json()["detail"]
        assert limited.http("unlimited", "PUT", "/v1/scenes/of-another", content=content).status_code == 201
