from pathlib import Path

import pytest

from ultragray.errors import InvalidArgument
from ultragray_service.settings import load_settings


def test_environment_sets_and_overrides_win(monkeypatch):
    monkeypatch.setenv("ULTRAGRAY_HTTP_PORT", "9000")
    monkeypatch.setenv("ULTRAGRAY_GRPC_PORT", "9001")
    monkeypatch.setenv("ULTRAGRAY_PRELOAD", "liver, spine")
    monkeypatch.setenv("ULTRAGRAY_DATA_FOLDER", "/scenes")
    settings = load_settings(grpc_port=9002)
    assert (settings.http_port, settings.grpc_port) == (9000, 9002)
    assert settings.preload == ("liver", "spine")
    assert settings.data_folder == Path("/scenes")


def test_defaults():
    settings = load_settings()
    assert (settings.host, settings.http_port, settings.grpc_port) == ("127.0.0.1", 8000, 50051)
    assert settings.max_poses_per_request == 1024
    assert settings.max_body_bytes == 8 * 2**20
    assert (settings.processes, settings.backend) == (0, "auto")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("http_port", "eighty"),
        ("default_timeout_s", "0"),
        ("backend", "gpu"),
        ("log_level", "loud"),
    ],
)
def test_bad_values_name_the_variable(monkeypatch, name, value):
    monkeypatch.setenv(f"ULTRAGRAY_{name.upper()}", value)
    with pytest.raises(InvalidArgument, match=f"ULTRAGRAY_{name.upper()}.*{value}") as caught:
        load_settings()
    assert caught.value.field == name


def test_short_keys_are_refused_and_no_key_is_shown(monkeypatch):
    monkeypatch.setenv("ULTRAGRAY_API_KEYS", "hunter2")
    with pytest.raises(InvalidArgument) as caught:
        load_settings()
    assert "hunter2" not in str(caught.value)
    monkeypatch.setenv("ULTRAGRAY_API_KEYS", "0123456789abcdef")
    assert "0123456789abcdef" not in repr(load_settings())


def test_folders_are_paths_or_urls(monkeypatch):
    monkeypatch.setenv("ULTRAGRAY_DATA_FOLDER", "s3://scenes/of/us")
    with pytest.raises(InvalidArgument, match=r"ULTRAGRAY_DATABASE_URL.*s3://scenes/of/us/artifacts.*SQLite"):
        load_settings()
    assert load_settings(artifact_folder="here").artifacts == Path("here")
    settings = load_settings(database_url="postgresql://host/jobs", cache_folder=Path("/var/cache/ultragray"))
    assert str(settings.data_folder) == "s3://scenes/of/us"
    assert str(settings.artifacts) == "s3://scenes/of/us/artifacts"
    assert settings.working_folder.parent == Path("/var/cache/ultragray/work")
    others = load_settings(database_url="postgresql://host/jobs", artifact_folder="s3://jobs", cache_folder=Path("c"))
    assert others.working_folder.name != settings.working_folder.name
    assert load_settings(data_folder="file:///srv/scenes").working_folder == Path("/srv/scenes/artifacts")


def test_urls_that_cannot_be_name_the_variable(monkeypatch):
    monkeypatch.setenv("ULTRAGRAY_ARTIFACT_FOLDER", "http://host/artifacts")
    with pytest.raises(InvalidArgument, match=r"ULTRAGRAY_ARTIFACT_FOLDER.*must be a path.*'http'"):
        load_settings()
