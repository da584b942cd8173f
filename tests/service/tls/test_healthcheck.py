"""The health check of containers against real services."""

import os
import subprocess
import sys

from ultragray_service.healthcheck import DEFAULT_HTTP_PORT, ready_url
from ultragray_service.settings import Settings

from ...certificates import write_client
from ..conftest import ROOT


def check(service, **environment):
    given = {f"ULTRAGRAY_{name.upper()}": str(value) for name, value in environment.items()}
    port = {"ULTRAGRAY_HTTP_PORT": service.http.rpartition(":")[2], "PYTHONPATH": str(ROOT / "service")}
    command = [sys.executable, "-m", "ultragray_service.healthcheck"]
    return subprocess.run(command, env={**os.environ, **port, **given}, capture_output=True, text=True, check=False)


def test_with_and_without_tls(service, start_service, mounted):
    assert check(service).returncode == 0
    encrypted = start_service(**mounted.settings())
    assert check(encrypted, **mounted.settings()).returncode == 0
    wrong = check(encrypted)
    assert wrong.returncode == 1
    assert wrong.stderr.startswith("http://127.0.0.1:")
    assert "Traceback" not in wrong.stderr


def test_mutual_tls_takes_a_certificate(start_service, mounted, tmp_path):
    settings = mounted.settings(mutual=True)
    service = start_service(**settings)
    certificate, key = write_client(mounted.authority, tmp_path)
    assert check(service, **settings).returncode == 1
    assert check(service, **settings, client_certificate=certificate, client_key=key).returncode == 0


def test_where_it_asks():
    assert str(Settings().http_port) == DEFAULT_HTTP_PORT
    assert ready_url({}) == "http://127.0.0.1:8000/v1/health/ready"
    assert ready_url({"ULTRAGRAY_HOST": "0.0.0.0", "ULTRAGRAY_HTTP_PORT": "1"}) == "http://127.0.0.1:1/v1/health/ready"
    assert ready_url({"ULTRAGRAY_HOST": "::1"}) == "http://[::1]:8000/v1/health/ready"
    assert ready_url({"ULTRAGRAY_HOST": "10.0.0.7", "ULTRAGRAY_TLS_CERTIFICATE": "x"}).startswith("https://10.0.0.7:")
