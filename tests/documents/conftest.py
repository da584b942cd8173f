"""The generator of the site."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from types import ModuleType

import pytest

from ..scripts import loaded_package
from ..surroundings import ROOT

Generator = Callable[[str], ModuleType]


@pytest.fixture(scope="session")
def generator() -> Generator:
    """A module of docs/generator by its name."""
    package = loaded_package(ROOT / "docs" / "generator")
    return lambda name: import_module(f"{package.__name__}.{name}")
