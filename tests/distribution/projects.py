"""The three projects of this repository, as their pyproject.toml say."""

from __future__ import annotations

import subprocess
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import tomllib
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from ..surroundings import ROOT

FOLDERS = {"ultragray": ROOT, "ultragray-client": ROOT / "client", "ultragray-proto": ROOT / "proto"}


def pyproject(name: str) -> dict[str, Any]:
    return tomllib.loads((FOLDERS[name] / "pyproject.toml").read_text(encoding="utf-8"))


def project(name: str) -> dict[str, Any]:
    found: dict[str, Any] = pyproject(name)["project"]
    return found


def packages(name: str) -> list[str]:
    """The import packages that the wheel of a project holds."""
    tool = pyproject(name)["tool"]
    folders = (
        tool["scikit-build"]["wheel"]["packages"]
        if name == "ultragray"
        else tool["hatch"]["build"]["targets"]["wheel"]["packages"]
    )
    return [folder.rpartition("/")[2] for folder in folders]


def unpacked(sdist: Path, folder: Path) -> Path:
    """The one folder that an sdist holds. By `tar`: the filters and warnings of tarfile depend on Python's version."""
    folder.mkdir()
    subprocess.run(["tar", "-xf", str(sdist), "-C", str(folder)], check=True)
    (source,) = folder.iterdir()
    return source


def required(requirements: list[str]) -> set[str]:
    """The canonical names of the distributions that requirements, whatever their markers, bring, and those in turn."""
    found: set[tuple[str, str]] = set()  # with the extra, "" for none
    waiting = [Requirement(text) for text in requirements]
    while waiting:
        one = waiting.pop()
        name = canonicalize_name(one.name)
        for extra in ("", *one.extras):
            if (name, extra) not in found:
                found.add((name, extra))
                waiting += needs(name, extra)
    return {name for name, _ in found}


def needs(name: str, extra: str) -> list[Requirement]:
    """What a distribution needs here for an extra; "" for none."""
    if name in FOLDERS:
        own = project(name)
        return [
            Requirement(text)
            for text in (own.get("optional-dependencies", {})[extra] if extra else own["dependencies"])
        ]
    return [need for need in of_distribution(name) if need.marker is None or need.marker.evaluate({"extra": extra})]


@cache
def of_distribution(name: str) -> list[Requirement]:
    try:
        return [Requirement(text) for text in metadata.requires(name) or ()]
    except metadata.PackageNotFoundError:  # of another platform, or an extra that is not installed
        return []
