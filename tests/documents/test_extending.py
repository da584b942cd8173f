"""docs/extending.md names files and names that exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from ultragray.contract import Contract, Family, described
from ultragray.datasets.source import DatasetFormat
from ultragray.exchange.exports.exporter import Exporter
from ultragray.exchange.exports.formats import Format
from ultragray.geometry.probe import Probe
from ultragray.learn.training.config import PRESETS, TrainingConfig
from ultragray.rendering.display import Display
from ultragray.rendering.tools import Tool
from ultragray_service.errors import STATUSES
from ultragray_workers.jobs.kinds import Specification

PAGE = Path(__file__).resolve().parents[2] / "docs" / "extending.md"
TEXT = PAGE.read_text(encoding="utf-8")
CLASSES = (Contract, Family, DatasetFormat, Display, Exporter, Format, Probe, Tool, TrainingConfig, Specification)
NAMED = {cls.__name__: cls for cls in CLASSES} | {"described": described, "PRESETS": PRESETS, "STATUSES": STATUSES}


@pytest.mark.parametrize("name", NAMED)
def test_names_of_the_code_are_those_of_the_page(name: str) -> None:
    assert re.search(rf"`{name}\b", TEXT), "the page does not name it"


def test_every_closed_set_has_its_section() -> None:
    sections = re.findall(r"^## (.+)$", TEXT, flags=re.MULTILINE)
    assert {"An output", "A probe", "A tool", "A dataset format", "A job kind", "A display setting"} <= set(sections)
    assert {"An exporter", "A training setting"} <= set(sections)
