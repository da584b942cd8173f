"""The process of a service and those around it: systemd, a terminal, its worker, the modes of its files."""

import asyncio
import logging
import os
import pty
import re
import select
import signal
import socket
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ultragray_service import server as embedded_worker
from ultragray_service.doors import Doors
from ultragray_service.server import ALIVE, READY, STOPPING, EmbeddedWorker, ServiceManager
from ultragray_service.settings import Settings
from ultragray_service.telemetry.logs import HumanFormatter

from ..waiting import at_this_load
from .cli.command_line import python

WAIT_S = 300.0


@pytest.fixture
def listener(tmp_path, monkeypatch):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.settimeout(WAIT_S)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        yield listening


def test_service_tells_when_it_is_ready_alive_and_stopping(listener, start_service, monkeypatch):
    monkeypatch.setenv("WATCHDOG_USEC", "600000")
    service = start_service(wait=False)
    told = [listener.recv(100).decode()]
    while told[-1] != READY:
        told.append(listener.recv(100).decode())
    service.wait_until_serving()
    while told[-1] != ALIVE:
        told.append(listener.recv(100).decode())
    service.process.send_signal(signal.SIGTERM)
    while told[-1] != STOPPING:
        told.append(listener.recv(100).decode())
    assert set(told) == {READY, ALIVE, STOPPING}
    assert service.terminate() == 0


def test_process_that_nobody_manages_tells_nobody(monkeypatch):
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    manager = ServiceManager()
    manager.tell(READY)
    assert manager.alive_every_s is None


def test_processes_that_it_starts_do_not_inherit_the_socket(listener, monkeypatch):
    monkeypatch.setenv("WATCHDOG_USEC", "30000000")
    monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()))
    manager = ServiceManager()
    assert manager.alive_every_s == pytest.approx(10.0)
    assert not {"NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"} & os.environ.keys()
    manager.tell(ALIVE)
    assert listener.recv(100).decode() == ALIVE


def test_manager_that_is_gone_or_busy_holds_nobody_up(listener, monkeypatch, tmp_path):
    manager = ServiceManager()
    for _ in range(10_000):  # nobody listens
        manager.tell(ALIVE)
    (tmp_path / "notify").unlink()
    manager.tell(STOPPING)


def mode(path):
    return stat.S_IMODE(path.stat().st_mode)


def test_others_cannot_read_what_a_service_makes(start_service, tmp_path):
    start_service(artifact_folder=tmp_path / "new")
    assert mode(tmp_path / "new") == 0o700
    assert mode(tmp_path / "new" / "jobs.sqlite") == 0o600


def test_what_is_there_keeps_its_mode(start_service, tmp_path):
    folder = tmp_path / "shared"
    folder.mkdir()
    folder.chmod(0o2770)
    (folder / "jobs.sqlite").touch()
    (folder / "jobs.sqlite").chmod(0o660)
    start_service(artifact_folder=folder)
    assert (mode(folder), mode(folder / "jobs.sqlite")) == (0o2770, 0o660)


OBEDIENT, DEAF = "", "signal.signal(signal.SIGTERM, signal.SIG_IGN)"


def run(folder, work, *, wanted=True):
    async def all_of_it():
        worker = EmbeddedWorker(Settings(data_folder=folder, embedded_worker=wanted))
        worker.start()
        try:
            await asyncio.wait_for(work(worker), 300)
        finally:
            await worker.stop()

    asyncio.run(all_of_it())


@pytest.fixture
def program(tmp_path, monkeypatch):
    """What runs in place of the worker; returns the file to which each of them adds its process id."""

    def use(source):
        started, script = tmp_path / "started", tmp_path / "python"
        tell = f"import os; open({str(started)!r}, 'a').write(f'{{os.getpid()}}\\n')"
        script.write_text(f"#!{sys.executable}\nimport signal, time\n{source}\n{tell}\ntime.sleep(3600)\n")
        script.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(script))
        return started

    return use


async def pids(started, count):
    while not started.exists() or len(found := started.read_text().split()) < count:
        await asyncio.sleep(0.02)
    return [int(pid) for pid in found]


def is_alive(pid):
    return Path(f"/proc/{pid}").exists()


def test_started_again_when_it_dies_and_ended_with_the_service(program, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(embedded_worker, "_FIRST_WAIT_S", 0.05)
    started = program(OBEDIENT)

    async def kill_one(worker):
        (first,) = await pids(started, 1)
        os.kill(first, signal.SIGKILL)
        _, second = await pids(started, 2)
        assert is_alive(second)

    run(tmp_path, kill_one)
    assert [is_alive(pid) for pid in map(int, started.read_text().split())] == [False, False]
    assert [record.message for record in caplog.records] == [
        "the worker for jobs ended with -9; the next one starts in 0.05 s"
    ]


def test_killed_where_nobody_waits_for_its_end(program, tmp_path):
    started = program(DEAF)

    async def give_up(worker):
        (pid,) = await pids(started, 1)
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(worker.stop(), 0.3)
        while is_alive(pid):
            await asyncio.sleep(0.02)

    run(tmp_path, give_up)


def test_none_where_none_is_wanted(program, tmp_path):
    started = program(OBEDIENT)
    run(tmp_path, lambda worker: asyncio.sleep(0.3), wanted=False)
    assert not started.exists()


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
