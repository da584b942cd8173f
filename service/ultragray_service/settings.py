"""Settings of the service, with units, defaults and limits: environment variables ULTRAGRAY_ + upper-case name."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ultragray.contract import Contract, annotated_fields, described, from_text
from ultragray.errors import InvalidArgument
from ultragray.image_size import MAX_IMAGE_SIDE
from ultragray_workers.pool.pool import MAX_BATCH_POSES

ENVIRONMENT_PREFIX = "ULTRAGRAY_"
LEAST_KEY_LENGTH = 16
_MAX_MB = 16_777_216
_HOUR_S = 3600.0


@dataclass(frozen=True, kw_only=True)
class Settings(Contract):
    """The settings of one service. Lists are written with commas: `ULTRAGRAY_PRELOAD=liver,spine`."""

    host: str = described("Address that all servers listen on; 0.0.0.0 for all.", "127.0.0.1")
    http_port: int = described("Port of HTTP; 0 takes a free one, which the log tells.", 8000, low=0, high=65535)
    grpc_port: int = described("Port of gRPC; 0 takes a free one.", 50051, low=0, high=65535)
    igtl_port: int | None = described(
        "Port of OpenIGTLink, usually 18944; 0 takes a free one; none: off.", None, low=0, high=65535
    )
    igtl_scene: str | None = described("Scene of OpenIGTLink devices whose names name none; none: the only one.", None)
    data_folder: Path = described(
        "Existing folder of the scene files (*.ugr); `ultragray serve` makes the default one, and puts the demo scene "
        "where there is none.",
        Path("data"),
    )
    preload: tuple[str, ...] = described("Scenes that are loaded before the service is ready.", ())

    processes: int = described(
        "Render processes; 0: one per GPU, on the CPU one. More than there are GPUs share them.", 0, low=0, high=256
    )
    threads_per_process: int = described("Render threads of each; 0: cores // processes.", 0, low=0, high=1024)
    backend: str = described(
        "Render backend; auto: cuda where there is a GPU, else cpu.",
        "auto",
        choices=("auto", "cpu", "cuda", "reference"),
    )
    queue_limit_frames: int = described(
        "Frames that may wait, interactive and batch frames each; beyond: QUEUE_FULL.", 256, low=1, high=100_000
    )
    max_batch_poses: int = described(
        "Waiting poses of one scene that are rendered together; fewer above 512x512 pixels.",
        16,
        low=1,
        high=MAX_BATCH_POSES,
    )
    memory_budget_mb: int = described(
        "MiB of scenes that each process keeps, on its GPU if it has one; the least recently used goes.",
        4096,
        low=16,
        high=_MAX_MB,
    )

    max_poses_per_request: int = described("Poses in one request.", 1024, low=1, high=100_000)
    max_image_side: int = described("Largest height and width, pixels.", 2048, low=1, high=MAX_IMAGE_SIDE)
    max_request_pixels: int = described(
        "Pixels that one answer may hold: poses x height x width x outputs.", 2**26, low=1, high=2**28
    )
    max_body_bytes: int = described("Largest HTTP request body.", 8 * 2**20, low=1024, high=2**30)

    artifact_folder: Path | None = described(
        "Folder of datasets and jobs, which all services and workers share; none: artifacts in the data folder.", None
    )
    max_dataset_bytes: int = described(
        "Largest upload: a scene file, or a dataset, packed and unpacked.", 8 * 2**30, low=1024, high=2**50
    )
    dataset_memory_mb: int = described(
        "MiB that the check of an upload, or what the console shows of a dataset, may take; one at a time.",
        8192,
        low=256,
        high=_MAX_MB,
    )
    upload_idle_timeout_s: float = described("How long an upload may send nothing.", 60.0, above=0.0, high=_HOUR_S)

    database_url: str | None = described(
        "PostgreSQL URL of the queue of jobs; none: a SQLite file in the artifact folder.", None, repr=False
    )
    job_queue_limit: int = described("Jobs that may wait; beyond: JOB_QUEUE_FULL.", 1000, low=1, high=100_000)
    embedded_worker: bool = described("Whether `ultragray serve` starts a worker for jobs as well.", True)
    training_threads: int = described(
        "Threads of a job's process; 0: all cores but one, at least one.", 0, low=0, high=1024
    )
    job_nice: int = described("Nice level of a job's process: frames go first.", 10, low=0, high=19)
    job_retention_days: float = described(
        "Days after which workers remove a finished job with its files (the scene that it trained stays); 0: never.",
        30.0,
        low=0.0,
        high=36_500.0,
    )

    default_timeout_s: float = described("Deadline of a request that names none.", 30.0, above=0.0, high=_HOUR_S)
    drain_timeout_s: float = described("How long frames that wait may take at a stop.", 10.0, low=0.0, high=_HOUR_S)

    api_keys: tuple[str, ...] = described(
        f"Keys of at least {LEAST_KEY_LENGTH} ASCII characters; where set, every request but health and documentation "
        "needs one.",
        (),
        repr=False,
    )
    cors_origins: tuple[str, ...] = described("Origins whose pages may call HTTP; * for all.", ())
    log_level: str = described("Least level that is logged.", "info", choices=("debug", "info", "warning", "error"))

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.host:
            raise InvalidArgument("host must be an address, got none", field="host")
        if any(len(key) < LEAST_KEY_LENGTH for key in self.api_keys):
            raise InvalidArgument(f"api_keys must have at least {LEAST_KEY_LENGTH} characters each", field="api_keys")
        if not all(key.isascii() for key in self.api_keys):
            raise InvalidArgument("api_keys must be of ASCII characters, as gRPC carries no others", field="api_keys")

    @property
    def artifacts(self) -> Path:
        """The artifact folder, resolved."""
        return self.data_folder / "artifacts" if self.artifact_folder is None else self.artifact_folder


def load_settings(**overrides: Any) -> Settings:
    """Settings of the environment, `overrides` on top. Raises InvalidArgument that names the setting and its limits."""
    values = {}
    for item, annotation in annotated_fields(Settings):
        value = overrides.get(item.name, os.environ.get(ENVIRONMENT_PREFIX + item.name.upper()))
        if value is not None:
            values[item.name] = from_text(value, annotation) if isinstance(value, str) else value
    try:
        return Settings(**values)
    except InvalidArgument as error:
        name = str(error.field).partition("[")[0]
        named = f"{name} (environment variable {ENVIRONMENT_PREFIX}{name.upper()})"
        raise InvalidArgument(error.detail.replace(name, named, 1), field=name) from None
