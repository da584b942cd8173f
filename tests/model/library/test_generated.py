"""The structures of libultragray are those of the contract: `make generate`, and read the difference."""

import runpy
from difflib import unified_diff
from pathlib import Path

GENERATOR = Path(__file__).parents[3] / "model" / "library" / "generate.py"


def test_the_contract_in_cpp_is_current():
    generator = runpy.run_path(str(GENERATOR))
    before, now = generator["TARGET"].read_text(encoding="utf-8"), generator["contract"]()
    assert not "".join(unified_diff(before.splitlines(True), now.splitlines(True), "committed", "the code", n=0))
