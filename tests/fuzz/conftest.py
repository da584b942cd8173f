"""Fuzzing: a seed and a number of inputs for each door, and a table of what was tried."""

import random
import shutil

import pytest

from ..service.conftest import data_folder, demo_scene, service_starter
from .campaign import Door
from .fuzzed import CONTROL_SCENE, FuzzedService

__all__ = ["data_folder", "demo_scene"]

_TRIED = "fuzz_inputs"


@pytest.fixture(scope="session")
def seed(request):
    """That of the command line; else another one in every run."""
    return int(request.config.getoption("--seed"))


@pytest.fixture
def door(seed, record_property):
    """Opens a door by its name; how many inputs it gets is told at the end."""
    return lambda name: Door(name, seed, lambda *tried: record_property(_TRIED, tried))


@pytest.fixture(scope="module")
def start_service(tmp_path_factory, data_folder):
    yield from service_starter(tmp_path_factory, data_folder)


@pytest.fixture(scope="module")
def fuzzed(start_service, data_folder, tmp_path_factory):
    """A service with a scene that no input names; checked at the end of each test, for which see `well`."""
    folder = tmp_path_factory.mktemp("fuzzed")
    for scene in ("demo", "second", "probeless"):
        shutil.copy(data_folder / f"{scene}.ugr", folder)
    shutil.copy(data_folder / "second.ugr", folder / f"{CONTROL_SCENE}.ugr")
    service = FuzzedService(start_service, folder, tmp_path_factory.mktemp("artifacts"))
    yield service
    service.end()


@pytest.fixture
def well(fuzzed):
    """The service, which is as well after the test as before it."""
    yield fuzzed
    fuzzed.check()


def pytest_configure(config):
    if config.getoption("--seed") is None:  # before the processes are started that run the tests: all have the same
        config.option.seed = random.SystemRandom().randrange(2**32)


def pytest_terminal_summary(terminalreporter, config):
    """The table of doors and inputs."""
    reports = [report for kind in ("passed", "failed") for report in terminalreporter.stats.get(kind, ())]
    rows = [value for report in reports for name, value in report.user_properties if name == _TRIED]
    if not rows:
        return
    terminalreporter.section(f"fuzzing, --seed {config.getoption('--seed')}")
    for door in dict.fromkeys(name for name, _, _ in rows):
        tried, seconds = (sum(row[column] for row in rows if row[0] == door) for column in (1, 2))
        terminalreporter.line(f"{door:20} {tried:8,} inputs {seconds:7.1f} s")
    terminalreporter.line(f"{'all':20} {sum(tried for _, tried, _ in rows):8,} inputs")
