"""The Dockerfile names what the project has: its folders, extras and the torch that it takes."""

from __future__ import annotations

import re
from pathlib import PurePosixPath

from packaging.requirements import Requirement

from ..distribution.projects import pyproject
from ..surroundings import ROOT

DOCKERFILE = (ROOT / "docker" / "Dockerfile").read_text()
IGNORED = (ROOT / ".dockerignore").read_text().splitlines()


def copied() -> set[str]:
    """What the build takes out of the checkout."""
    lines = [line.split()[1:-1] for line in DOCKERFILE.splitlines() if re.match(r"COPY (?!--from)", line)]
    return {source for sources in lines for source in sources}


def test_what_is_copied_is_there_and_reaches_the_build() -> None:
    assert all((ROOT / source).exists() for source in copied())
    let_through = {line.removeprefix("!/") for line in IGNORED if line.startswith("!")}
    assert {PurePosixPath(source).parts[0] for source in copied() - {"."}} == let_through


def test_extras_are_those_of_the_project() -> None:
    wanted = re.search(r"'\.\[([a-z,]+)\]'", DOCKERFILE)
    assert wanted is not None
    assert set(wanted[1].split(",")) <= set(pyproject("ultragray")["project"]["optional-dependencies"])


def test_torch_is_one_that_the_project_takes() -> None:
    (torch,) = (
        Requirement(one) for one in pyproject("ultragray")["project"]["dependencies"] if one.startswith("torch")
    )
    wanted = re.search(r"^ARG TORCH_VERSION=(.+)$", DOCKERFILE, re.MULTILINE)
    assert wanted is not None
    assert wanted[1] in torch.specifier
