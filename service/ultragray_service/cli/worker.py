"""`ultragray worker`: does the jobs of a queue; `ultragray serve` starts one by `python -m` this module."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, Any

from ultragray.errors import UltragrayError
from ultragray_service.cli.options import FieldsOf, pairs_of, with_options
from ultragray_service.cli.terminal import option, single
from ultragray_service.server import ALIVE, READY, ServiceManager
from ultragray_service.settings import ENVIRONMENT_PREFIX, Settings, load_settings
from ultragray_workers.errors import StartupFailed
from ultragray_workers.processes import end_with_parent, let_frames_go_first


@single(
    "ultragray worker --artifact-folder /srv/ultragray/artifacts",
    "ultragray worker --device cuda:1 --name gpu-1 --label site=lab1 --label rack=4",
)
@with_options
def worker(
    name: Annotated[str | None, option("Name of this worker, its alone.", shown="of the host, numbered")] = None,
    device: Annotated[
        str, option("auto: every GPU of the host, and its processor; cpu; cuda: every GPU; or cuda:N.")
    ] = "auto",
    label: Annotated[
        list[str] | None, option("A label that jobs can ask for; may be given several times.", metavar="NAME=VALUE")
    ] = None,
    *,
    options: Annotated[
        dict[str, Any],
        FieldsOf(
            Settings,
            *("data_folder", "artifact_folder", "database_url", "training_threads", "log_format", "log_level"),
            environment=ENVIRONMENT_PREFIX,
        ),
    ],
) -> None:
    """A job at hand is put back with a checkpoint when the worker stops.

    What is not given here comes from the settings (ULTRAGRAY_…).
    """
    run_worker(options, name=name, device=device, labels=pairs_of(label or [], "--label"))


def run_worker(
    overrides: dict[str, Any],
    *,
    name: str | None = None,
    device: str = "auto",
    labels: Mapping[str, str] = MappingProxyType({}),
) -> None:
    """Do jobs until SIGTERM or SIGINT, then end the process; a second signal ends the drain at once."""
    from opentelemetry import trace

    from ultragray_service.telemetry.logs import configure_logging, start_tracing
    from ultragray_workers.jobs.worker.supervision import WorkerConfig
    from ultragray_workers.jobs.worker.worker import work
    from ultragray_workers.storage.location import open_storage

    settings = load_settings(**overrides)
    configure_logging(settings.log_level, settings.log_format)
    if not settings.is_there:
        raise StartupFailed(
            f"artifact_folder must be an existing folder, got {str(settings.artifacts)!r}", field="artifact_folder"
        )
    manager = ServiceManager()
    tracing = start_tracing("worker")
    if tracing is not None:
        trace.set_tracer_provider(tracing.provider)
    stop, hurry = threading.Event(), threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda received, frame: (hurry if stop.is_set() else stop).set())
    config = WorkerConfig(
        settings.working_folder,
        open_storage(settings.artifacts),
        settings.database_url,
        name,
        device,
        labels,
        max_copies_bytes=settings.max_cache_bytes,
        threads=settings.training_threads,
        nice=settings.job_nice,
        max_footprint_pixels=settings.max_footprint_pixels,
        retention_days=settings.job_retention_days,
        stall_timeout_s=settings.job_stall_timeout_s,
        max_run_s=settings.job_max_run_s,
        drain_timeout_s=settings.job_drain_timeout_s,
    )
    work(
        config,
        stop,
        hurry=hurry,
        ready=lambda: manager.tell(READY),
        alive_every_s=manager.alive_every_s,
        tell_alive=lambda: manager.tell(ALIVE),
    )
    if tracing is not None:
        tracing.stop()
    sys.stderr.flush()
    os._exit(0)  # work that a storage which is away keeps would be waited for


def main(service_pid: str) -> int:
    """The worker within `ultragray serve`, which it does not outlive."""
    end_with_parent(signal.SIGTERM)
    if os.getppid() != int(service_pid):
        return 1
    try:
        let_frames_go_first(load_settings().job_nice)  # its looks at the queue would hold up frames, as jobs would
        run_worker({})
    except UltragrayError as error:
        sys.stderr.write(f"ultragray worker: {error.detail}\n")
    return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
