"""A host of several: its services and workers are processes that share a bucket and a database with others."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from ultragray.phantom.demo import copy_demo_scene

from ..waiting import wait_until

_START_TIMEOUT_S = 180.0

# Each process of ours imports this first: checkpoints and take-overs come as often as a short test needs them.
_PATCHES = """
import sys
line = " ".join(sys.orig_argv)
if "ultragray_workers.jobs.worker.run_job" in line:
    from ultragray_workers.jobs.kinds import train_run
    train_run.CHECKPOINT_INTERVAL_S = 0.3
elif "worker" in line:
    from ultragray_workers.jobs import queue
    queue.DEAD_AFTER_S = 3.0
"""
_SERVE = [sys.executable, "-m", "ultragray_service"]
_WORK = [sys.executable, "-c", "from ultragray_service.cli.app import app; app()", "worker", "--device", "cpu"]


class Host:
    """Sees nothing of other hosts but the bucket and the database; its data folder has the demo scene."""

    def __init__(self, folder: Path, artifacts: str, database_url: str, **settings: str) -> None:
        self.folder, self.data, self.cache = folder, folder / "data", folder / "cache"
        for one in (self.data, self.cache, folder / "logs", folder / "patches"):
            one.mkdir(parents=True)
        copy_demo_scene(self.data / "demo.ugr")
        (folder / "patches" / "sitecustomize.py").write_text(_PATCHES)
        self._environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(folder / "patches"), *filter(None, sys.path)]),
            "OMP_NUM_THREADS": "1",
            "ULTRAGRAY_DATA_FOLDER": str(self.data),
            "ULTRAGRAY_ARTIFACT_FOLDER": artifacts,
            "ULTRAGRAY_CACHE_FOLDER": str(self.cache),
            "ULTRAGRAY_DATABASE_URL": database_url,
            "ULTRAGRAY_EMBEDDED_WORKER": "false",
            "ULTRAGRAY_HTTP_PORT": "0",
            "ULTRAGRAY_GRPC_PORT": "0",
            "ULTRAGRAY_THREADS_PER_PROCESS": "1",
            "ULTRAGRAY_TRAINING_THREADS": "1",
            "ULTRAGRAY_JOB_NICE": "0",
            **settings,
        }
        self.processes: list[subprocess.Popen[bytes]] = []

    def serve(self) -> tuple[str, str]:
        """Starts a service; its addresses of HTTP and gRPC."""
        process, log = self._spawn(_SERVE, "service")

        def addresses() -> tuple[str, str] | None:
            assert process.poll() is None, self.told()
            for line in log.read_text().splitlines():
                if '"grpc"' in line and line.endswith("}"):
                    record = json.loads(line)
                    return record["http"], record["grpc"]
            return None

        return wait_until(addresses, within_s=_START_TIMEOUT_S)

    def work(self) -> subprocess.Popen[bytes]:
        """Starts a worker."""
        return self._spawn(_WORK, "worker")[0]

    def kill_all(self) -> None:
        """As a loss of power: the processes of jobs die with their workers."""
        for process in self.processes:
            process.kill()
            process.wait()

    def told(self) -> str:
        """The ends of the logs, for the message of a test that fails."""
        logs = sorted((self.folder / "logs").iterdir())
        return "\n".join(f"--- {self.folder.name}/{log.name}\n{log.read_text()[-4000:]}" for log in logs)

    def _spawn(self, command: list[str], kind: str) -> tuple[subprocess.Popen[bytes], Path]:
        path = self.folder / "logs" / f"{kind}-{len(self.processes)}"
        with path.open("ab") as log:
            self.processes.append(subprocess.Popen(command, env=self._environment, stdout=log, stderr=log))
        return self.processes[-1], path
