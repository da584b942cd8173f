"""Surroundings of their own for the tests: what the user's folders and environment hold changes nothing."""

import os
from pathlib import Path

import pytest
import trustme

ROOT = Path(__file__).resolve().parents[1]

_SWITCHES_OF_TESTS = tuple(
    f"ULTRAGRAY_{of}_" for of in ("FAULT", "FUZZ", "OVERLOAD", "REPLICAS", "SHARDS", "SOAK", "TEST", "UPDATE")
)
_FOREIGN_PREFIXES = (
    "ULTRAGRAY_",
    "OTEL_",
    "PG",
    "XDG_",
    "GRPC_",
    "UVICORN_",
    "WEB_CONCURRENCY",
    "AWS_",
    "AZURE_",
    "GOOGLE_",
)
_FOREIGN = {
    *("ALL_PROXY", "HTTP_PROXY", "HTTPS_PROXY", "NO_PROXY"),  # in either case
    *("NETRC", "SSL_CERT_FILE", "SSL_CERT_DIR", "SSLKEYLOGFILE"),
    *(
        "CI",
        "GITHUB_ACTIONS",
        "FORCE_COLOR",
        "PY_COLORS",
        "NO_COLOR",
        "COLUMNS",
        "LINES",
    ),  # they change what rich prints
    *("PYTHONWARNINGS", "PYTHONASYNCIODEBUG"),
}


def forget_the_users_environment():
    """Take out of this process's environment whatever could change what a test sees."""
    for name in list(os.environ):
        if name.startswith(_SWITCHES_OF_TESTS):
            continue
        if name.upper() in _FOREIGN or name.startswith(_FOREIGN_PREFIXES):
            del os.environ[name]


@pytest.fixture(scope="session", autouse=True)
def home_of_the_tests(tmp_path_factory):
    """An empty home for this process and all that it starts, and a working folder that is not the checkout.

    They trust one authority, which signed nothing: to read those of the world takes a client of httpx 25 ms, each time.
    """
    home = tmp_path_factory.mktemp("home")
    trustme.CA().cert_pem.write_to_path(home / "authority.pem")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOME", str(home))
        patch.setenv("SSL_CERT_FILE", str(home / "authority.pem"))
        patch.chdir(tmp_path_factory.mktemp("working"))
        yield home


@pytest.fixture(autouse=True)
def working_folder(tmp_path_factory, monkeypatch):
    """An empty working folder for each test."""
    folder = tmp_path_factory.mktemp("working")
    monkeypatch.chdir(folder)
    return folder
