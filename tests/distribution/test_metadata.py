"""What the four projects say about themselves, and which of them owns which package."""

import re

import pytest

from ultragray.installation import __version__
from ultragray.phantom.demo import copy_demo_scene

from ..surroundings import ROOT
from .projects import FOLDERS, packages, project

PROJECTS = sorted(FOLDERS)


@pytest.mark.parametrize("name", PROJECTS)
def test_the_readme_holds_without_the_repository(name):
    text = (FOLDERS[name] / project(name)["readme"]).read_text(encoding="utf-8")
    links = re.findall(r"\]\(([^)]*)\)", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    assert [link for link in links if "://" not in link] == [], "a package index does not have the files beside it"


@pytest.mark.slow
def test_the_example_of_the_library_runs(working_folder):
    copy_demo_scene(working_folder / "demo.ugr")
    text = (ROOT / project("ultragray")["readme"]).read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    names = {}
    exec(example, names)
    assert tuple(names["frames"].bmode.shape) == (4, 256, 256)


def test_every_package_has_one_owner():
    owned = [package for name in PROJECTS for package in packages(name)]
    there = {path.parent.name for path in ROOT.glob("*/ultragray*/__init__.py")}
    assert sorted(owned) == sorted(there)


def test_service_and_client_need_the_messages_of_their_version():
    wanted = f"ultragray-proto~={__version__}"
    assert wanted in project("ultragray")["optional-dependencies"]["serve"]
    assert wanted in project("ultragray-client")["dependencies"]


def test_client_and_messages_pin_what_the_service_pins():
    own = project("ultragray")
    service = {*own["dependencies"], *own["optional-dependencies"]["serve"]}
    for name in ("ultragray-client", "ultragray-proto"):
        assert set(project(name)["dependencies"]) <= service
