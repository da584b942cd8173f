"""Workers that start at the same moment on a database in which there is nothing yet."""

import os
import subprocess
import sys

import pytest

WORKERS, ROUNDS = 4, 10
# Everything is imported once; of each round, all workers begin when the last of them is ready.
PROGRAM = f"""
import logging, os, sys, threading, traceback
from pathlib import Path
from ultragray_workers.jobs.worker.supervision import WorkerConfig
from ultragray_workers.jobs.worker.worker import work
from ultragray_workers.storage.local import LocalStorage

def start(url, number, ready, go):
    logging.basicConfig(stream=sys.stdout, format="%(levelname)s %(message)s")
    stop = threading.Event()
    stop.set()
    os.write(ready, b".")
    os.read(go, 1)
    try:
        folder, name = Path(sys.argv[1]), f"worker-{{number}}"
        work(WorkerConfig(folder, LocalStorage(folder), url or None, name, device="cpu"), stop)
        print("stopped", flush=True)
    except BaseException:
        traceback.print_exc(file=sys.stdout)
    sys.stdout.flush()
    os._exit(0)

for url in sys.argv[2:]:
    ready, told = os.pipe()
    waiting, go = os.pipe()
    children = []
    for number in range({WORKERS}):
        children.append(os.fork())
        if not children[-1]:
            start(url, number, told, waiting)
    for _ in children:
        os.read(ready, 1)
    os.write(go, b"." * {WORKERS})
    for child in children:
        os.waitpid(child, 0)
"""


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
def test_workers_that_start_together_on_a_fresh_database(kind, tmp_path, request):
    if kind == "postgresql":
        server = request.getfixturevalue("postgres")
        urls = [server.create_database() for _ in range(ROUNDS)]
    else:
        urls = [f"sqlite:///{tmp_path}/{number}.sqlite" for number in range(ROUNDS)]
    told = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path / "artifacts"), *urls],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=600,
    ).stdout
    assert told.splitlines() == ["stopped"] * WORKERS * ROUNDS
