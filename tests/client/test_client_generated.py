"""The committed client for threads is the one that client/generate.py makes of the client for asyncio."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

CLIENT = Path(__file__).resolve().parents[2] / "client"
BY_HAND = {"__init__.py", "transport.py"}


@pytest.fixture(scope="module")
def generator() -> ModuleType:
    spec = importlib.util.spec_from_file_location("generate_client", CLIENT / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_client_for_threads_is_current(generator: ModuleType, tmp_path: Path) -> None:
    generated = {path.name: path.read_text() for path in generator.generate_sync(tmp_path)}
    committed = {path.name: path.read_text() for path in (CLIENT / "ultragray_client" / "sync").glob("*.py")}
    assert {name: text for name, text in committed.items() if name not in BY_HAND} == generated


def test_nothing_of_asyncio_is_left_in_it(generator: ModuleType, tmp_path: Path) -> None:
    for path in generator.generate_sync(tmp_path):
        for word in ("asyncio", "async ", "await ", "aiter", "anext"):
            assert word not in path.read_text(), f"{word!r} in {path.name}"
