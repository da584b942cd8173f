"""The worker that `ultragray serve` brings along: a process of its own, started again when it dies."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

from ultragray_service.settings import ENVIRONMENT_PREFIX, Settings
from ultragray_workers.rounds import Rounds

_FIRST_WAIT_S, _LONGEST_WAIT_S = 0.5, 30.0
_STEADY_S = 60.0  # a worker that lived so long is started again after the first wait
_STOP_WAIT_S = 20.0  # beside what a job has to end
_PASSED_ON = (
    "data_folder",
    "artifact_folder",
    "cache_folder",
    "max_cache_bytes",
    "database_url",
    "training_threads",
    "job_nice",
    "max_footprint_pixels",
    "job_drain_timeout_s",
    "job_retention_days",
    "log_format",
    "log_level",
)

_log = logging.getLogger("ultragray.service")


class EmbeddedWorker:
    """Its methods belong to the event loop's thread, which must be the main one: the worker dies with it."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._stop = asyncio.Event()
        self._process: subprocess.Popen[bytes] | None = None
        self._task: asyncio.Task[None] | None = None
        self._thread = ThreadPoolExecutor(1, "embedded-worker")  # not the loop's, which others need

    def start(self) -> None:
        """Starts the worker and returns at once; nothing where the settings want none."""
        if self._settings.embedded_worker:
            self._task = asyncio.create_task(self._keep_alive())

    async def stop(self) -> None:
        """Ends the worker, which puts the job at hand back into the queue."""
        self._stop.set()
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
        if self._task is None:
            return
        try:
            await asyncio.wait({self._task}, timeout=_STOP_WAIT_S + self._settings.job_drain_timeout_s)
        finally:  # also where the caller was cancelled
            if self._process is not None and self._process.poll() is None:
                self._process.kill()
        await self._task

    async def _keep_alive(self) -> None:
        wait_s = _FIRST_WAIT_S
        rounds = Rounds("the watch over the worker for jobs", _log)
        while not self._stop.is_set():
            started = time.monotonic()
            with rounds.round():  # a process that cannot be started, for want of memory or files, can be later
                self._process = self._spawn()
                code = await asyncio.get_running_loop().run_in_executor(self._thread, self._process.wait)
                if self._stop.is_set():
                    return
                if time.monotonic() - started > _STEADY_S:
                    wait_s = _FIRST_WAIT_S
                _log.warning(f"the worker for jobs ended with {code}; the next one starts in {wait_s:g} s")
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._stop.wait(), wait_s)
            wait_s = min(2.0 * wait_s, _LONGEST_WAIT_S)

    def _spawn(self) -> subprocess.Popen[bytes]:
        values = {name: getattr(self._settings, name) for name in _PASSED_ON}
        given = {ENVIRONMENT_PREFIX + name.upper(): str(value) for name, value in values.items() if value is not None}
        # Not asyncio's: it forks, which gRPC complains about.
        return subprocess.Popen(
            [sys.executable, "-m", "ultragray_service.cli.worker", str(os.getpid())],
            stdin=subprocess.DEVNULL,
            env={**os.environ, **given, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
            start_new_session=True,  # Ctrl-C is for the service, which then stops the worker
        )
