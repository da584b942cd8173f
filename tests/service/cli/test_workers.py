"""`ultragray workers` against a real service with its worker."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from ultragray_service.cli.app import app

from ...waiting import wait_until
from ..conftest import RunningService, StartService


@pytest.fixture(scope="module")
def server(start_service: StartService, tmp_path_factory: pytest.TempPathFactory) -> RunningService:
    return start_service(artifact_folder=tmp_path_factory.mktemp("artifacts"), embedded_worker=True, training_threads=1)


def test_commands_list_pause_drain_and_resume(server: RunningService) -> None:
    def run(*arguments: str) -> str:
        result = CliRunner().invoke(app, ["workers", *arguments], env={"ULTRAGRAY_ADDRESS": server.http})
        assert result.exit_code == 0, result.output
        return result.stdout

    def states() -> dict[str, str]:
        return {worker["name"]: worker["state"] for worker in json.loads(run("list", "--json"))}

    assert wait_until(lambda: "idle" in states().values())
    (name,) = states()
    for wish, state in (("pause", "paused"), ("drain", "drained"), ("resume", "idle")):
        assert run(wish, name) == f"{name} {state}\n"
        assert states() == {name: state}
    assert run("list").splitlines()[0].split()[:3] == ["name", "state", "job"]
    absent = CliRunner().invoke(app, ["workers", "pause", "absent"], env={"ULTRAGRAY_ADDRESS": server.http})
    assert absent.exit_code == 2
    assert "absent" in absent.stderr
