"""The generator of the site, and the run of a page."""

import shutil
from importlib import import_module

import pytest

from ultragray.phantom.demo import copy_demo_scene

from ..scripts import loaded_package
from ..service.conftest import service_starter
from ..surroundings import ROOT
from .blocks import read_page
from .running import PageRun

DOCUMENTS = sorted(
    path
    for pattern in ("*.md", "docs/**/*.md", "*/README.md", "tests/documents/README.md")
    for path in ROOT.glob(pattern)
)
TUTORIAL = ROOT / "docs" / "tutorial.md"


@pytest.fixture(scope="session")
def generator():
    """A module of docs/generator by its name."""
    package = loaded_package(ROOT / "docs" / "generator")
    return lambda name: import_module(f"{package.__name__}.{name}")


@pytest.fixture(scope="module")
def start_service(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    copy_demo_scene(folder / "demo.ugr")
    yield from service_starter(tmp_path_factory, folder)


@pytest.fixture(scope="module")
def shared_ports(start_service):
    """The ports of the service that the pages share, which is started by the first page that needs it."""
    found = {}

    def ports():
        if not found:
            service = start_service(igtl_port=0, igtl_scene="demo", embedded_worker=True)
            (record,) = (record for record in service.log() if "grpc" in record)
            found.update((door, int(record[door].rpartition(":")[2])) for door in ("http", "grpc", "igtl"))
        return found

    return ports


@pytest.fixture
def run_page(shared_ports, tmp_path, monkeypatch):
    """Runs a page in a folder of its own."""

    def run(path):
        page = read_page(path)
        for need in page.needs:
            if shutil.which(need) is None:
                pytest.skip(f"{need} is not installed")
        folder = tmp_path / "page"
        folder.mkdir()
        monkeypatch.chdir(folder)
        with PageRun(page, folder, shared_ports) as page_run:
            for name, value in page_run.environment().items():
                monkeypatch.setenv(name, value)
            for block in page.runs:
                page_run.run(block)

    return run
