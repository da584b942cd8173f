"""The stops of the tour: each file and each function is there, and what they say of the flow is what happens."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TOUR = ROOT / "docs" / "tour.md"
STOP = re.compile(r"^(\d+)\. \[(?P<shown>[^]]+)\]\(\.\./(?P<path>[^)]+)\): `(?P<name>[\w.]+)`\.", re.MULTILINE)


def stops():
    """Path and function of the stops of each flow."""
    flows = TOUR.read_text(encoding="utf-8").split("\n## ")[1:]
    return {flow.partition("\n")[0]: [(one["path"], one["name"]) for one in STOP.finditer(flow)] for flow in flows}


@pytest.mark.parametrize("flow", stops())
def test_a_flow_has_twelve_stops_that_are_there(flow):
    found = stops()[flow]
    assert len(found) == 12
    for path, name in found:
        scope = ast.parse((ROOT / path).read_text(encoding="utf-8")).body
        for part in name.split("."):
            definitions = [one for one in scope if getattr(one, "name", None) == part]
            assert definitions, f"{path} has no {name}"
            scope = definitions[-1].body
