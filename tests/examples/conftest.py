"""The examples against a real service of the demo scene."""

import importlib.util
import sys

import pytest

from ultragray.phantom.demo import DEMO_FILE

from ..service.conftest import ROOT, start_shared_service

__all__ = ["start_shared_service"]

EXAMPLES = ROOT / "examples"


@pytest.fixture(scope="session")
def data_folder(tmp_path_factory):
    """The demo scene alone."""
    folder = tmp_path_factory.mktemp("demo")
    (folder / "demo.ugr").symlink_to(DEMO_FILE)
    return folder


@pytest.fixture(scope="session")
def demo_service(start_shared_service):
    return start_shared_service(preload="demo")


@pytest.fixture(scope="session")
def load_example():
    def load(name):
        spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        spec.loader.exec_module(module)
        return module

    return load
