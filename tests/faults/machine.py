"""A computer that runs `ultragray serve` and a second worker, starts both again when they die, and can be struck."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

from ..waiting import Deadline

CHECKPOINT_INTERVAL_S = 0.3
DEAD_AFTER_S = 3.0
_START_TIMEOUT_S = 180.0
_STOP_TIMEOUT_S = 30.0

# Each process of ours imports this first: checkpoints and take-overs come as often as the kills do.
PATCHES = f"""
import sys
line = " ".join(sys.orig_argv)
if "ultragray_workers.jobs.worker.template" in line:
    from ultragray_workers.jobs.kinds import train_run
    train_run.CHECKPOINT_INTERVAL_S = {CHECKPOINT_INTERVAL_S}
elif "worker" in line:
    from ultragray_workers.jobs import queue
    queue.DEAD_AFTER_S = {DEAD_AFTER_S}
"""
SERVE = [sys.executable, "-m", "ultragray_service"]
WORK = [sys.executable, "-c", "from ultragray_service.cli.app import app; app()", "worker", "--device", "cpu"]


def environment(folder, **settings):
    """That of a service and a worker, whose data are below a folder."""
    patches = folder / "patches"
    patches.mkdir()
    (patches / "sitecustomize.py").write_text(PATCHES)
    return {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(patches), *filter(None, sys.path)]),
        "OMP_NUM_THREADS": "1",
        "ULTRAGRAY_DATA_FOLDER": str(folder / "data"),
        "ULTRAGRAY_HTTP_PORT": "0",
        "ULTRAGRAY_GRPC_PORT": "0",
        "ULTRAGRAY_THREADS_PER_PROCESS": "1",
        "ULTRAGRAY_TRAINING_THREADS": "1",
        "ULTRAGRAY_JOB_NICE": "0",
        **settings,
    }


class Machine:
    """Its processes; `tend` must be called often."""

    def __init__(self, folder, **settings):
        self.data, self.artifacts = folder / "data", folder / "data" / "artifacts"
        self.database_url = settings.get("ULTRAGRAY_DATABASE_URL")
        self.http = None  # while the server listens
        self.grpc = None
        self._logs = folder / "logs"
        self._logs.mkdir(parents=True)
        self.data.mkdir()
        self._environment = environment(folder, **settings)
        self._servers = []
        self._workers = []
        self._with_workers = False

    def start_without_workers(self):
        """The server alone, listening when this returns."""
        self.tend()
        end = Deadline(_START_TIMEOUT_S)
        while self.http is None:
            assert not end.passed, self.told()
            time.sleep(0.05)
            self.tend()

    def bring_workers(self):
        """From now on there is a worker of its own, and one in each server that is started."""
        self._with_workers = True

    def tend(self):
        """Starts again what has died, and learns where the server listens."""
        if not self._servers or self._servers[-1].poll() is not None:
            self.http = self.grpc = None
            embedded = {"ULTRAGRAY_EMBEDDED_WORKER": str(self._with_workers)}
            self._servers.append(self._spawn(SERVE, f"server-{len(self._servers)}", embedded))
        if self._with_workers and (not self._workers or self._workers[-1].poll() is not None):
            self._workers.append(self._spawn(WORK, f"worker-{len(self._workers)}", {}))
        if self.http is None:
            log = self._logs / f"server-{len(self._servers) - 1}"
            for line in log.read_text().splitlines():
                if '"grpc"' in line and line.endswith("}"):
                    record = json.loads(line)
                    self.http, self.grpc = record["http"], record["grpc"]

    def _spawn(self, command, name, settings):
        with (self._logs / name).open("ab") as log:
            return subprocess.Popen(command, env={**self._environment, **settings}, stdout=log, stderr=log)

    def strike(self, kind, chance):
        """SIGKILL to one process of a kind, chosen at random, or to `all`; False where there is none."""
        processes = self._processes()
        found = [pid for pids in processes.values() for pid in pids] if kind == "all" else processes[kind]
        if not found or (kind == "all" and not all(processes.values())):
            return False
        chance.shuffle(found)
        _kill(found if kind == "all" else found[:1])
        return True

    def stop_for_a_while(self, kind, chance, seconds):
        """SIGSTOP to one process of a kind, and SIGCONT later where it still is; False where there is none."""
        if not (found := self._processes()[kind]):
            return False
        pid = chance.choice(found)
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGSTOP)
            self.tend_for(seconds)
            os.kill(pid, signal.SIGCONT)
        return True

    def tend_for(self, seconds):
        """Tends it for a while."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.tend()
            time.sleep(0.05)

    def _processes(self):
        """The processes that live, by kind; embedded workers also of servers that died."""
        found = {"job": [], "template": [], "worker": [], "server": []}
        for process, kind in [(self._servers[-1:], "server"), (self._workers[-1:], "worker")]:
            found[kind] += [one.pid for one in process if one.poll() is None]
        embedded = {f"ultragray_service.cli.worker {server.pid}" for server in self._servers}
        forks = {}  # parents by process
        for path in Path("/proc").glob("[0-9]*/cmdline"):
            try:
                line = path.read_text().replace("\0", " ").strip()
            except OSError:  # it has ended
                continue
            if any(line.endswith(end) for end in embedded):
                found["worker"].append(int(path.parent.name))
            elif "jobs.worker.template" in line:  # or a job that it has forked
                with suppress(OSError):
                    forks[int(path.parent.name)] = _parent(path.parent)
        found["template"] += [pid for pid, parent in forks.items() if parent in found["worker"]]
        found["job"] += [pid for pid, parent in forks.items() if parent in found["template"]]
        return found

    def halt_jobs(self):
        """The processes of jobs stand still from now on, alive."""
        for pid in self._processes()["job"]:
            os.kill(pid, signal.SIGSTOP)

    def stop(self):
        """Ends the server and the worker as a service manager does; their exit codes."""
        last = [*self._servers[-1:], *self._workers[-1:]]
        for process in last:
            process.terminate()
        return [process.wait(_STOP_TIMEOUT_S) for process in last]

    def kill_all(self):
        """Whatever is left of it."""
        for pids in self._processes().values():
            _kill(pids)
        for process in [*self._servers, *self._workers]:
            process.wait()

    def told(self):
        """The ends of all logs, for the message of a test that fails."""
        return "\n".join(f"--- {log.name}\n{log.read_text()[-1500:]}" for log in sorted(self._logs.iterdir())[-6:])


def _parent(process):
    """The number of the parent of a process, by its folder of /proc."""
    return int((process / "stat").read_text().rpartition(")")[2].split()[1])


def _kill(pids):
    for pid in pids:
        with suppress(ProcessLookupError):  # it ended by itself
            os.kill(pid, signal.SIGKILL)
