"""The public names of the Python packages are those of public_names.txt, with their signatures.

After a wanted change: ULTRAGRAY_UPDATE_SNAPSHOTS=1 pytest tests/documents/test_public_names.py; read the difference.
"""

from __future__ import annotations

import os
from difflib import unified_diff
from pathlib import Path

from .conftest import Generator

SNAPSHOT = Path(__file__).with_name("public_names.txt")


def test_public_names_are_those_of_the_snapshot(generator: Generator) -> None:
    current = generator("python_api").snapshot()
    if os.environ.get("ULTRAGRAY_UPDATE_SNAPSHOTS") == "1":
        SNAPSHOT.write_text(current, encoding="utf-8")
    before = SNAPSHOT.read_text(encoding="utf-8")
    assert not "".join(unified_diff(before.splitlines(True), current.splitlines(True), "snapshot", "code", n=0))
