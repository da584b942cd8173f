"""The five projects of this repository, as their pyproject.toml say."""

import subprocess
from functools import cache

import tomllib
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from ..surroundings import ROOT

FOLDERS = {
    "ultragray": ROOT,
    "ultragray-client": ROOT / "client",
    "ultragray-proto": ROOT / "proto",
    "ultragray-ros": ROOT / "ros",
    "ultragray-studies": ROOT / "studies",
}


@cache
def pyproject(name):
    return tomllib.loads((FOLDERS[name] / "pyproject.toml").read_text(encoding="utf-8"))


def project(name):
    return pyproject(name)["project"]


def packages(name):
    """The import packages that the wheel of a project holds."""
    tool = pyproject(name)["tool"]
    folders = (
        tool["scikit-build"]["wheel"]["packages"]
        if name == "ultragray"
        else tool["hatch"]["build"]["targets"]["wheel"]["packages"]
    )
    return [folder.rpartition("/")[2] for folder in folders]


def unpacked(sdist, folder):
    """The one folder that an sdist holds. By `tar`: the filters and warnings of tarfile depend on Python's version."""
    folder.mkdir()
    subprocess.run(["tar", "-xf", str(sdist), "-C", str(folder)], check=True)
    (source,) = folder.iterdir()
    return source


def names_of(requirements):
    """The canonical names of the distributions that requirements name."""
    return {canonicalize_name(Requirement(text).name) for text in requirements}
