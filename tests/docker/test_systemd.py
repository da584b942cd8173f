"""The units of docker/systemd: systemd understands them, and what they name is there."""

from __future__ import annotations

import configparser
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from ultragray.contract import annotated_fields
from ultragray_service.cli.app import app as command_line
from ultragray_service.settings import ENVIRONMENT_PREFIX, Settings

UNITS = Path(__file__).resolve().parents[2] / "docker" / "systemd"
PROGRAM = "/opt/ultragray/bin/ultragray"
SERVICES = sorted(UNITS.glob("*.service"))


def section(unit: Path, name: str) -> configparser.SectionProxy:
    parser = configparser.ConfigParser(interpolation=None, strict=False, delimiters="=", comment_prefixes="#")
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read_string(unit.read_text())
    return parser[name]


def test_systemd_understands_every_unit(tmp_path: Path) -> None:
    analyze = shutil.which("systemd-analyze")
    if analyze is None:
        pytest.skip("systemd is not installed: on Debian, apt-get install systemd")
    names = []
    for unit in (*SERVICES, *UNITS.glob("*.timer")):
        name = unit.name.replace("@.", "@0.")
        text = unit.read_text().replace(PROGRAM, sys.executable)
        (tmp_path / name).write_text(text)
        if name != unit.name:
            (tmp_path / unit.name).write_text(text)
        names.append(f"./{name}")
    done = subprocess.run([analyze, "verify", "--man=no", *names], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("unit", SERVICES, ids=lambda unit: unit.name)
def test_commands_options_and_settings_are_there(unit: Path) -> None:
    service = section(unit, "Service")
    program, command, *given = service["ExecStart"].split()
    assert program == PROGRAM
    options = {option for parameter in _commands()[command].params for option in parameter.opts}
    assert {word for word in given if word.startswith("--")} <= options
    known = {ENVIRONMENT_PREFIX + item.name.upper() for item, _ in annotated_fields(Settings)}
    named = set(re.findall(rf"{ENVIRONMENT_PREFIX}\w+", unit.read_text()))
    assert named <= known


def _commands() -> dict[str, typer.core.TyperCommand]:
    commands: dict[str, typer.core.TyperCommand] = typer.main.get_command(command_line).commands  # type: ignore[attr-defined]
    return commands


def test_service_may_take_its_time_to_stop() -> None:
    longest = Settings().drain_timeout_s
    assert int(section(UNITS / "ultragray.service", "Service")["TimeoutStopSec"]) > 2 * longest


def test_document_names_every_file() -> None:
    document = (UNITS.parents[1] / "docs" / "operation.md").read_text()
    assert [path.name for path in sorted(UNITS.iterdir()) if path.name not in document] == []
