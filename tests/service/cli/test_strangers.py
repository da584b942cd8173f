"""Commands that ask a service over TLS, or something else answers: another server, a proxy, one that breaks off."""

import threading
import zipfile
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import ClassVar

import pytest
import trustme
from typer.testing import CliRunner

from ultragray.errors import DatasetInvalid
from ultragray_service.cli.app import USER_ERROR, app
from ultragray_service.cli.connection import exposes_key
from ultragray_service.cli.remote import archive_of

from ...certificates import Mounted, write_client

KEY = "0123456789abcdef-strangers"


class Stranger(BaseHTTPRequestHandler):
    """Answers by the path, and remembers the keys that it was given."""

    keys: ClassVar[list[str | None]] = []
    answers: ClassVar[dict[str, tuple[int, dict[str, str], bytes]]] = {
        "/page": (200, {"Content-Type": "text/html"}, b"<html>welcome</html>"),
        "/list": (200, {}, b"[]"),
        "/short": (200, {"Content-Length": "100"}, b"{"),
    }

    def do_GET(self):
        self.keys.append(self.headers["X-API-Key"])
        place = "/" + self.path.split("/")[1]
        there = f"http://localhost:{self.server.server_address[1]}/page"
        status, headers, body = self.answers.get(place, (307, {"Location": there}, b""))
        self.send_response(status)
        for name, value in ({"Content-Length": str(len(body))} | headers).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format, *args):
        pass


@pytest.fixture
def stranger():
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
def test_what_is_no_service_is_told_in_one_line(stranger, place, told):
    address = f"{stranger}/{place}"
    result = CliRunner().invoke(app, ["scenes", "list", "--address", address, "--api-key", KEY])
    assert result.exit_code == 2
    assert result.stderr.startswith(f"error: {address}")
    assert told in result.stderr
    assert result.stderr.count("\n") == 1


def test_a_key_is_not_sent_on_to_where_an_address_redirects(stranger):
    CliRunner().invoke(app, ["scenes", "list", "--address", f"{stranger}/elsewhere", "--api-key", KEY])
    assert Stranger.keys == [KEY]


def test_an_upload_takes_the_files_of_the_sweep_alone(tmp_path):
    for name in ("a[1].mhd", "a[1].raw", "a[1].patient.pdf", "a[1].ugr"):
        (tmp_path / name).write_bytes(b"x")
    assert archived(tmp_path / "a[1].mhd") == ["a[1].mhd", "a[1].raw"]


def test_a_folder_is_uploaded_without_what_is_hidden(tmp_path):
    for name in ("conf.json", "images_train.npy", ".git/objects/ab", ".notes"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x")
    assert archived(tmp_path) == ["conf.json", "images_train.npy"]
    with pytest.raises(DatasetInvalid, match="must hold a folder with"), archive_of(tmp_path / ".git"):
        pass


def archived(source):
    with archive_of(source) as archive, zipfile.ZipFile(archive) as opened:
        return sorted(opened.namelist())


@pytest.fixture(scope="module")
def mounted(tmp_path_factory):
    return Mounted(tmp_path_factory.mktemp("certificates") / "tls")


def listed(server, **environment):
    variables = {f"ULTRAGRAY_{name.upper()}": str(value) for name, value in environment.items()}
    return CliRunner().invoke(app, ["jobs", "list", "--address", server], env=variables)


def refusal(server, **environment):
    result = listed(server, **environment)
    assert result.exit_code == USER_ERROR, result.output
    return " ".join(result.stderr.split())


def test_jobs_are_asked_over_tls(start_service, mounted, tmp_path):
    service = start_service(**mounted.settings(mutual=True))
    certificate, key = write_client(mounted.authority, tmp_path)
    own = {"client_certificate": certificate, "client_key": key}
    assert listed(service.http, ca=mounted.root, **own).exit_code == 0
    stranger = tmp_path / "stranger.pem"
    trustme.CA().cert_pem.write_to_path(stranger)
    assert "--client-certificate" in refusal(service.http, ca=mounted.root)
    assert "a certificate that is not to be trusted" in refusal(service.http, ca=stranger, **own)
    assert "name its authority with --ca" in refusal(service.http, **own)
    assert "if it speaks TLS, name it with https://" in refusal(service.http.replace("https", "http"))


def test_tls_to_a_service_without_it(service):
    assert "does not speak TLS: name it with http://" in refusal(service.http.replace("http", "https"))


def test_files_that_cannot_be_used(mounted, tmp_path):
    certificate, _ = write_client(mounted.authority, tmp_path)
    server = "https://127.0.0.1:1"
    assert "must be given together" in refusal(server, client_certificate=certificate)
    assert "no certificate and its key (" in refusal(server, client_certificate=certificate, client_key=certificate)
    assert "holds no certificates (No such file" in refusal(server, ca=tmp_path / "none")


def test_a_key_that_travels_openly_is_told():
    warning = "warning: the API key travels unencrypted to "
    assert warning not in listed("http://127.0.0.1:1", api_key="0123456789abcdef").stderr
    assert warning in listed("http://host.invalid:1", api_key="0123456789abcdef").stderr
    assert exposes_key("http://192.0.2.1:1")
    assert exposes_key("http://scanner:8000")
    assert not exposes_key("http://localhost:8000")
    assert not exposes_key("http://[::1]:8000")
    assert not exposes_key("https://scanner:8000")
