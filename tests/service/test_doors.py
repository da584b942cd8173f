"""What a service says to whom has started it."""

import logging
import os
import pty
import re
import select
import signal
import subprocess
import time
from pathlib import Path

import pytest

from ultragray_service.doors import Doors
from ultragray_service.settings import Settings
from ultragray_service.telemetry.logs import HumanFormatter

from ..waiting import at_this_load
from .cli.command_line import python


def record(level, message, **fields):
    made = logging.LogRecord("ultragray.service", level, "", 0, message, (), None)
    made.fields = fields
    return made


def test_a_banner_has_the_addresses_and_how_to_stop():
    doors = Doors.of(Settings(data_folder=Path("scenes")), 8000, 50051, "127.0.0.1:18944")
    lines = dict(line.split(maxsplit=1) for line in doors.banner(False).splitlines() if line.startswith("  "))
    assert lines["console"] == "http://127.0.0.1:8000/"
    assert lines["gRPC"] == "127.0.0.1:50051"
    assert lines["OpenIGTLink"] == "127.0.0.1:18944"
    assert lines["scenes"] == "scenes"
    assert lines["stop"] == "Ctrl-C"
    assert "not needed: this machine alone is served" in doors.banner(False)
    assert re.search(r"API key +needed\n", doors.banner(True))


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])
def test_a_banner_names_an_address_that_a_browser_opens(host):
    doors = Doors.of(Settings(host=host, tls_certificate=Path("c.pem"), tls_key=Path("k.pem")), 80, 50051, None)
    assert "console     https://localhost:80/" in doors.banner(True)
    assert "OpenIGTLink" not in doors.banner(True)
    assert "NOT NEEDED BY ANYBODY" in doors.banner(False)


def test_a_line_for_people_is_time_level_and_sentence():
    plain = HumanFormatter(in_colour=False)
    assert re.fullmatch(r"\d\d:\d\d:\d\d stopped", plain.format(record(logging.INFO, "stopped")))
    assert plain.format(record(logging.WARNING, "no space"))[9:] == "warning: no space"
    facts = {"method": "GET", "path": "/v1/scenes", "status": 200, "duration_ms": 12.34}
    assert plain.format(record(logging.INFO, "request", **facts))[9:] == "GET /v1/scenes: 200 in 12 ms"
    forged = {"method": "GET", "path": "/\x1b[2J\n12:00:00 stopped", "status": 404, "duration_ms": 1.0}
    assert plain.format(record(logging.INFO, "request", **forged))[9:] == (
        "GET /\\x1b[2J\\n12:00:00 stopped: 404 in 1 ms"
    )
    assert "\x1b[31merror: \x1b[0m" in HumanFormatter(in_colour=True).format(record(logging.ERROR, "lost"))


def read_until(terminal, wanted, process):
    """What a process wrote to its terminal, up to `wanted`."""
    said, end = "", time.monotonic() + at_this_load(60)
    while wanted not in said:
        assert time.monotonic() < end, said
        ready, _, _ = select.select([terminal], [], [], 1.0)
        if ready:
            said += os.read(terminal, 65536).decode()
        elif process.poll() is not None:
            raise AssertionError(said)
    return said


@pytest.mark.long
def test_on_a_terminal_it_speaks_to_people(tmp_path):
    ours, theirs = pty.openpty()
    program = "from ultragray_service.cli.app import app; app()"
    command = python(program, "serve", "--http-port", 0, "--grpc-port", 0, "--threads", 1)
    environment = {**os.environ, "ULTRAGRAY_HTTP_PROT": "1", "ULTRAGRAY_EMBEDDED_WORKER": "no"}
    with subprocess.Popen(command, stderr=theirs, stdout=theirs, cwd=tmp_path, env=environment) as process:
        os.close(theirs)
        try:
            said = read_until(ours, "Ctrl-C", process)
            process.send_signal(signal.SIGTERM)
            said += read_until(ours, "stopped", process)
            assert process.wait(at_this_load(30)) == 0
        finally:
            process.kill()
            os.close(ours)
    assert re.search(r"console +http://127\.0\.0\.1:\d+/\r\n", said)
    assert re.search(r"HTTP docs +http://127\.0\.0\.1:\d+/docs\r\n", said)
    assert "holds no scenes: wrote" in said
    assert "did you mean ULTRAGRAY_HTTP_PORT?" in said
    assert "starting to serve the scenes of data" in said
    assert "stopping: frames that wait are answered first" in said
    assert '{"time"' not in said
