"""Every file of figures is registered and says where it comes from; its target leaves the tree clean."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from datetime import datetime
from pathlib import Path

import pytest

from ..scripts import benchmark
from ..surroundings import ROOT

registry = benchmark("registry")
FIGURES = registry.FIGURES
TARGETS = sorted({file.target for file in FIGURES.values()})
MAKES_OWN = ("MAKEFLAGS", "MFLAGS", "MAKELEVEL", "RECORD", "ARGS")  # the last two: as it was called
ABSOLUTE_PATH = re.compile(r"(?<![\w.:/])/[\w.-]+/[\w.-]+")
NOT_MEASURED_YET = {"benchmarks/cuda.json", "benchmarks/cuda_training.json"}


def test_every_file_is_registered() -> None:
    found = [*(ROOT / "benchmarks").glob("*.json"), *(ROOT / "tests").glob("*-run.json")]
    known = {file.path for file in FIGURES.values()}
    assert {str(path.relative_to(ROOT)) for path in found} == known - NOT_MEASURED_YET


@pytest.mark.parametrize("name", [name for name, file in FIGURES.items() if file.path not in NOT_MEASURED_YET])
def test_a_file_says_commit_date_and_machine(name: str) -> None:
    heads = list(registry.heads(json.loads(FIGURES[name].kept.read_text(encoding="utf-8"))))
    assert heads
    for head in heads:
        assert head["commit"]
        assert "dirty" not in head["commit"]
        assert datetime.fromisoformat(head["date"]).tzinfo is not None
        assert head["machine"]["processor"]


@pytest.mark.parametrize("name", [name for name, file in FIGURES.items() if file.path not in NOT_MEASURED_YET])
def test_a_file_names_no_place_on_the_machine_it_was_measured_on(name: str) -> None:
    assert ABSOLUTE_PATH.findall(FIGURES[name].kept.read_text(encoding="utf-8")) == []


def test_what_is_measured_is_there() -> None:
    for file in FIGURES.values():
        for path in file.measures:
            pattern = path.removeprefix(":(exclude)")
            assert list(ROOT.glob(pattern)), f"{file.path}: {pattern}"


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
@pytest.mark.parametrize("target", TARGETS)
def test_measuring_leaves_the_tree_clean_and_recording_is_asked_for(target: str, tmp_path: Path) -> None:
    staged = [name for name, file in FIGURES.items() if file.target == target]
    plain = recipe(target)
    assert "benchmarks/record.py" not in plain
    for name in staged:
        assert FIGURES[name].path not in plain
    recorded = recipe(target, "RECORD=1")
    assert recorded.index("record.py --ready") < recorded.index(f"record.py {' '.join(staged)}\n")


def recipe(target: str, *variables: str) -> str:
    """The commands of a target, not run; a make that runs this test passes nothing on."""
    environment = {name: value for name, value in os.environ.items() if name not in MAKES_OWN}
    command = [
        "make",
        "--dry-run",
        "--no-print-directory",
        "--directory",
        str(ROOT),
        target,
        *variables,
    ]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
