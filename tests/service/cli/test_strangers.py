"""Commands that ask a service, and something else answers: another kind of server, a proxy, one that breaks off."""

from __future__ import annotations

import threading
import zipfile
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import ClassVar

import pytest
from typer.testing import CliRunner

from ultragray.errors import DatasetInvalid
from ultragray_service.cli.app import app
from ultragray_service.cli.remote import archive_of

KEY = "0123456789abcdef-strangers"


class Stranger(BaseHTTPRequestHandler):
    """Answers by the path, and remembers the keys that it was given."""

    keys: ClassVar[list[str | None]] = []
    answers: ClassVar[dict[str, tuple[int, dict[str, str], bytes]]] = {
        "/page": (200, {"Content-Type": "text/html"}, b"<html>welcome</html>"),
        "/list": (200, {}, b"[]"),
        "/short": (200, {"Content-Length": "100"}, b"{"),
    }

    def do_GET(self) -> None:
        self.keys.append(self.headers["X-API-Key"])
        place = "/" + self.path.split("/")[1]
        there = f"http://localhost:{self.server.server_address[1]}/page"
        status, headers, body = self.answers.get(place, (307, {"Location": there}, b""))
        self.send_response(status)
        for name, value in ({"Content-Length": str(len(body))} | headers).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def stranger() -> Iterator[str]:
    Stranger.keys = []
    server = ThreadingHTTPServer(("127.0.0.1", 0), Stranger)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_address[1]}"
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.mark.parametrize(
    ("place", "told"),
    [
        ("page", "answered, but not as an UltraG-Ray service does"),
        ("list", "answered, but not as an UltraG-Ray service does"),
        ("short", "broke off its answer"),
        ("elsewhere", "redirects to http://localhost:"),
    ],
)
def test_what_is_no_service_is_told_in_one_line(stranger: str, place: str, told: str) -> None:
    address = f"{stranger}/{place}"
    result = CliRunner().invoke(app, ["scenes", "list", "--address", address, "--api-key", KEY])
    assert result.exit_code == 2
    assert result.stderr.startswith(f"error: {address}")
    assert told in result.stderr
    assert result.stderr.count("\n") == 1


def test_a_key_is_not_sent_on_to_where_an_address_redirects(stranger: str) -> None:
    CliRunner().invoke(app, ["scenes", "list", "--address", f"{stranger}/elsewhere", "--api-key", KEY])
    assert Stranger.keys == [KEY]


def test_an_upload_takes_the_files_of_the_sweep_alone(tmp_path: Path) -> None:
    for name in ("a[1].mhd", "a[1].raw", "a[1].patient.pdf", "a[1].ugr"):
        (tmp_path / name).write_bytes(b"x")
    assert archived(tmp_path / "a[1].mhd") == ["a[1].mhd", "a[1].raw"]


def test_a_folder_is_uploaded_without_what_is_hidden(tmp_path: Path) -> None:
    for name in ("conf.json", "images_train.npy", ".git/objects/ab", ".notes"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x")
    assert archived(tmp_path) == ["conf.json", "images_train.npy"]
    with pytest.raises(DatasetInvalid, match="no sweep lies in this folder"), archive_of(tmp_path / ".git"):
        pass


def archived(source: Path) -> list[str]:
    with archive_of(source) as archive, zipfile.ZipFile(archive) as opened:
        return sorted(opened.namelist())
