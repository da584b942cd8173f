"""The command line in this process, or as a fresh one."""

from __future__ import annotations

import sys

from typer.testing import CliRunner, Result

from ultragray_service.cli.app import app


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def refused(*arguments: object) -> str:
    """The one line that a mistake gives."""
    result = run(*arguments)
    assert result.exit_code == 2, result.output
    assert "Traceback" not in result.output
    assert result.stderr.startswith("error: ")
    assert result.stderr.count("\n") == 1
    return result.stderr


def python(program: str, *arguments: object) -> list[str]:
    """A command for a fresh process that finds the packages as this one does."""
    return [sys.executable, "-c", f"import sys; sys.path[:0] = {sys.path!r}; {program}", *map(str, arguments)]
