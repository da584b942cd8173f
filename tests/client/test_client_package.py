"""The distribution: what its wheel and sdist hold, what it needs, and what an import of it takes."""

from __future__ import annotations

import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path
from typing import Any

import ultragray_client

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[2]


def project(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = tomllib.loads(path.read_text())["project"]
    return found


def sources(folder: Path) -> set[str]:
    files = (path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    return {path.relative_to(folder.parent).as_posix() for path in files}


def build(folder: Path, target: str, output: Path) -> Path:
    command = [sys.executable, "-m", "hatchling", "build", "-t", target, "-d", str(output)]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    return next(output.iterdir())


def test_the_wheel_carries_client_and_stubs_and_nothing_else(tmp_path: Path) -> None:
    with zipfile.ZipFile(build(ROOT / "client", "wheel", tmp_path)) as wheel:
        files = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert files == sources(ROOT / "client" / "ultragray_client") | sources(ROOT / "proto" / "ultragray_proto")
    assert "ultragray_client/py.typed" in files


def test_a_wheel_of_the_sdist_is_the_same(tmp_path: Path) -> None:
    with tarfile.open(build(ROOT / "client", "sdist", tmp_path / "sdist")) as sdist:
        sdist.extractall(tmp_path / "unpacked", filter="data")
    (unpacked,) = (tmp_path / "unpacked").iterdir()
    with zipfile.ZipFile(build(unpacked, "wheel", tmp_path / "wheel")) as wheel:
        files = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert files == sources(ROOT / "client" / "ultragray_client") | sources(ROOT / "proto" / "ultragray_proto")


def test_version_and_pins_are_those_of_the_service() -> None:
    own, service = project(ROOT / "client" / "pyproject.toml"), project(ROOT / "pyproject.toml")
    assert own["version"] == service["version"]
    assert own["requires-python"] == service["requires-python"]
    assert set(own["dependencies"]) <= set(service["dependencies"])
    assert {requirement.split(">")[0] for requirement in own["dependencies"]} == {"grpcio", "numpy", "protobuf"}


def test_an_import_takes_no_more_than_it_needs() -> None:
    program = "import sys, ultragray_client; print(*{name.split('.')[0] for name in sys.modules})"
    told = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True).stdout
    assert {"ultragray_client", "ultragray_proto", "grpc", "numpy"} <= set(told.split())
    assert not {"torch", "ultragray", "ultragray_service", "ultragray_workers", "pydantic"} & set(told.split())


def test_exported_names_exist() -> None:
    assert len(set(ultragray_client.__all__)) == len(ultragray_client.__all__)
    for name in ultragray_client.__all__:
        assert hasattr(ultragray_client, name)
