"""Surroundings of their own for the tests: what the user's folders and environment hold changes nothing."""

import os
from pathlib import Path

import pytest

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
    """An empty home for this process and all that it starts, and a working folder that is not the checkout."""
    home = tmp_path_factory.mktemp("home")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOME", str(home))
        patch.chdir(tmp_path_factory.mktemp("working"))
        yield home


@pytest.fixture(autouse=True)
def working_folder(tmp_path_factory, monkeypatch):
    """An empty working folder for each test."""
    folder = tmp_path_factory.mktemp("working")
    monkeypatch.chdir(folder)
    return folder
