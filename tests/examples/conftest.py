"""The examples against a real service of the demo scene."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from ultragray.phantom.demo import DEMO_FILE

from ..service.conftest import ROOT, RunningService, StartService, start_shared_service

__all__ = ["start_shared_service"]

EXAMPLES = ROOT / "examples"


@pytest.fixture(scope="session")
def data_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo scene alone."""
    folder = tmp_path_factory.mktemp("demo")
    (folder / "demo.ugr").symlink_to(DEMO_FILE)
    return folder


@pytest.fixture(scope="session")
def demo_service(start_shared_service: StartService) -> RunningService:
    return start_shared_service(preload="demo")


@pytest.fixture(scope="session")
def load_example() -> Callable[[str], ModuleType]:
    def load(name: str) -> ModuleType:
        spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        spec.loader.exec_module(module)
        return module

    return load
