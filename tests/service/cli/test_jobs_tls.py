"""`ultragray jobs` over TLS."""

from __future__ import annotations

from pathlib import Path

import pytest
import trustme
from typer.testing import CliRunner, Result

from ultragray_service.cli.app import USER_ERROR, app
from ultragray_service.cli.connection import exposes_key

from ...certificates import Mounted, write_client
from ..conftest import RunningService, StartService


@pytest.fixture(scope="module")
def mounted(tmp_path_factory: pytest.TempPathFactory) -> Mounted:
    found = Mounted(tmp_path_factory.mktemp("certificates") / "tls")
    found.put(found.issue())
    return found


def listed(server: str, **environment: object) -> Result:
    variables = {f"ULTRAGRAY_{name.upper()}": str(value) for name, value in environment.items()}
    return CliRunner().invoke(app, ["jobs", "list", "--address", server], env=variables)


def refusal(server: str, **environment: object) -> str:
    result = listed(server, **environment)
    assert result.exit_code == USER_ERROR, result.output
    return " ".join(result.stderr.split())


def test_jobs_are_asked_over_tls(start_service: StartService, mounted: Mounted, tmp_path: Path) -> None:
    service = start_service(**mounted.settings())
    assert listed(service.http, ca=mounted.root).exit_code == 0
    stranger = tmp_path / "stranger.pem"
    trustme.CA().cert_pem.write_to_path(stranger)
    assert "a certificate that is not to be trusted" in refusal(service.http, ca=stranger)
    assert "name its authority with --ca" in refusal(service.http)
    assert "if it speaks TLS, name it with https://" in refusal(service.http.replace("https", "http"))


def test_mutual_tls(start_service: StartService, mounted: Mounted, tmp_path: Path) -> None:
    service = start_service(**mounted.settings(mutual=True))
    certificate, key = write_client(mounted.authority, tmp_path)
    own = {"ca": mounted.root, "client_certificate": certificate, "client_key": key}
    assert listed(service.http, **own).exit_code == 0
    assert "--client-certificate" in refusal(service.http, ca=mounted.root)


def test_tls_to_a_service_without_it(service: RunningService) -> None:
    assert "does not speak TLS: name it with http://" in refusal(service.http.replace("http", "https"))


def test_files_that_cannot_be_used(mounted: Mounted, tmp_path: Path) -> None:
    certificate, _ = write_client(mounted.authority, tmp_path)
    server = "https://127.0.0.1:1"
    assert "must be given together" in refusal(server, client_certificate=certificate)
    assert "no certificate and its key (" in refusal(server, client_certificate=certificate, client_key=certificate)
    assert "holds no certificates (No such file" in refusal(server, ca=tmp_path / "none")


def test_a_key_that_travels_openly_is_told() -> None:
    warning = "warning: the API key travels unencrypted to "
    assert warning not in listed("http://127.0.0.1:1", api_key="0123456789abcdef").stderr
    assert warning in listed("http://host.invalid:1", api_key="0123456789abcdef").stderr
    assert exposes_key("http://192.0.2.1:1")
    assert exposes_key("http://scanner:8000")
    assert not exposes_key("http://localhost:8000")
    assert not exposes_key("http://[::1]:8000")
    assert not exposes_key("https://scanner:8000")
