"""What the code says of itself is what the committed snapshots say: `make generate`, and read the difference."""

from __future__ import annotations

from difflib import unified_diff

from ..surroundings import ROOT
from .conftest import Generator


def test_snapshots_are_current(generator: Generator) -> None:
    for name, text in generator("snapshots").SNAPSHOTS.items():
        before, now = (ROOT / name).read_text(encoding="utf-8"), text()
        assert not "".join(unified_diff(before.splitlines(True), now.splitlines(True), name, "the code", n=0))
