"""The head of measured figures."""

from __future__ import annotations

import json
import os
from datetime import datetime
from pathlib import Path

import pytest

from ultragray.rendering.backends import cpu
from ultragray_service.bench import measured


def test_the_head_says_commit_date_and_machine(capsys: pytest.CaptureFixture[str]) -> None:
    measured.main()
    head = json.loads(capsys.readouterr().out)
    assert list(head) == ["commit", "date", "machine"]
    assert datetime.fromisoformat(head["date"]).tzinfo is not None
    machine = head["machine"]
    assert (machine["threads"], machine["cores"]) == (os.cpu_count(), os.cpu_count())
    assert machine["instruction_set"] == cpu.INSTRUCTION_SETS[0]
    assert machine["memory_gib"] > 0.1
    assert measured.measured(1)["machine"] == {**machine, "threads": 1}


def test_an_installed_package_has_no_commit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measured, "ROOT", tmp_path)
    assert measured.commit() is None
