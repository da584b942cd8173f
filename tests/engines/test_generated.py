"""The contract in C#, and what Unity keeps beside each file, are current: `make generate`, and read the difference."""

import runpy
from difflib import unified_diff

import pytest

from .conftest import ENGINES


@pytest.fixture(scope="module")
def generator():
    return runpy.run_path(str(ENGINES / "generate.py"))


def test_the_contract_in_csharp_is_current(generator):
    before, now = generator["TARGET"].read_text(encoding="utf-8"), generator["contract"]()
    assert not "".join(unified_diff(before.splitlines(True), now.splitlines(True), "committed", "the code", n=0))


def test_each_file_of_a_package_has_its_number(generator):
    expected = generator["metas"]()
    found = {path: path.read_text() for path in ENGINES.rglob("*.meta")}
    assert found == expected
    assert len(set(found.values())) == len(found) > 10
