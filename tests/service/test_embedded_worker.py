"""The worker of `ultragray serve`, as a process that takes no jobs: what becomes of it, not what it does."""

import asyncio
import os
import signal
import sys
import time
from pathlib import Path

import pytest

from ultragray_service import server as embedded_worker
from ultragray_service.server import EmbeddedWorker
from ultragray_service.settings import Settings

from ..waiting import at_this_load

OBEDIENT, DEAF = "", "signal.signal(signal.SIGTERM, signal.SIG_IGN)"


def run(folder, work, *, wanted=True):
    async def all_of_it():
        worker = EmbeddedWorker(Settings(data_folder=folder, embedded_worker=wanted))
        worker.start()
        try:
            await asyncio.wait_for(work(worker), 20)
        finally:
            await worker.stop()

    asyncio.run(all_of_it())


@pytest.fixture
def program(tmp_path, monkeypatch):
    """What runs in place of the worker; returns the file to which each of them adds its process id."""

    def use(source):
        started, script = tmp_path / "started", tmp_path / "python"
        tell = f"import os; open({str(started)!r}, 'a').write(f'{{os.getpid()}}\\n')"
        script.write_text(f"#!{sys.executable}\nimport signal, time\n{source}\n{tell}\ntime.sleep(60)\n")
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
        began = time.monotonic()
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(worker.stop(), 0.3)
        while is_alive(pid):
            await asyncio.sleep(0.02)
        assert time.monotonic() - began < at_this_load(3.0)

    run(tmp_path, give_up)


def test_none_where_none_is_wanted(program, tmp_path):
    started = program(OBEDIENT)
    run(tmp_path, lambda worker: asyncio.sleep(0.3), wanted=False)
    assert not started.exists()
