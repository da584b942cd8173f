"""Replicas and workers on hosts of their own: each has its folder and ports, and shares storage and database alone."""

import os
import signal
import socket
import subprocess
import sys

import httpx

from ..faults.machine import WORK
from ..service.conftest import RunningService

DRAIN_DELAY_S = 5.0  # as docker/envoy/envoy.yaml asks for
_STOP_TIMEOUT_S = 60.0


class ReplicaHost:
    """A service that can be struck, drained and started again at the same ports."""

    def __init__(self, folder, shared):
        """`shared`: settings that all hosts have, with the places of storage and database."""
        self.folder = folder
        folder.mkdir()
        doors = [socket.create_server(("127.0.0.1", 0)) for _ in range(2)]
        self.http_port, self.grpc_port = (door.getsockname()[1] for door in doors)
        for door in doors:
            door.close()
        self._settings = {
            **shared,
            "ULTRAGRAY_CACHE_FOLDER": str(folder / "cache"),
            "ULTRAGRAY_HTTP_PORT": str(self.http_port),
            "ULTRAGRAY_GRPC_PORT": str(self.grpc_port),
            "ULTRAGRAY_DRAIN_DELAY_S": str(DRAIN_DELAY_S),
            "ULTRAGRAY_READY_WITHOUT_JOBS": "true",
            "ULTRAGRAY_MAX_QUEUE_MS": "60000",  # others may keep the machine busy: no frame is refused for that
            "ULTRAGRAY_MAX_CONNECTIONS_PER_ADDRESS": "2048",  # all of Envoy's
        }
        self.starts = 0
        self.start()

    def start(self):
        """Starts it; it is not yet ready when this returns."""
        self.starts += 1
        log = self.folder / f"log-{self.starts}"
        self.service = RunningService(self.folder, log, self._settings)

    def wait_until_serving(self):
        self.service.wait_until_serving()

    def strike(self):
        """Kills it as a power cut would."""
        self.service.process.send_signal(signal.SIGKILL)
        self.service.process.wait(_STOP_TIMEOUT_S)

    def drain(self):
        """Stops it as an operator would; its exit status."""
        return self.service.terminate()

    def loaded_scenes(self):
        """The scenes that it has in memory."""
        page = httpx.get(f"{self.service.http}/v1/scenes?page_size=1000", timeout=60).raise_for_status().json()
        return [scene["name"] for scene in page["scenes"] if scene["loaded"]]

    def frames(self):
        """The frames that it has rendered since it was started."""
        return self.service.metric("ultragray_frames_total")

    def stop(self):
        self.service.process.send_signal(signal.SIGTERM)
        self.service.process.send_signal(signal.SIGTERM)  # at once
        self.service.process.wait(_STOP_TIMEOUT_S)


class WorkerHost:
    """A worker for jobs that can be struck and started again."""

    def __init__(self, folder, shared):
        self.folder = folder
        folder.mkdir()
        self._environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
            "OMP_NUM_THREADS": "1",
            "ULTRAGRAY_TRAINING_THREADS": "1",
            "ULTRAGRAY_CACHE_FOLDER": str(folder / "cache"),
            **shared,
        }
        self.start()

    def start(self):
        with (self.folder / "log").open("ab") as log:
            self.process = subprocess.Popen(WORK, env=self._environment, cwd=self.folder, stdout=log, stderr=log)

    def strike(self):
        self.process.kill()
        self.process.wait(_STOP_TIMEOUT_S)

    def stop(self):
        self.process.terminate()
        self.process.wait(_STOP_TIMEOUT_S)
