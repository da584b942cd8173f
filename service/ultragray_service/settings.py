"""What can be set, with units, defaults and limits: environment variables ULTRAGRAY_ + upper-case name."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, SecretStr, ValidationError, field_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from ultragray.errors import InvalidArgument
from ultragray.image_size import MAX_IMAGE_SIDE
from ultragray_workers.pool.pool import MAX_BATCH_POSES

ENVIRONMENT_PREFIX = "ULTRAGRAY_"

Words = Annotated[tuple[str, ...], NoDecode]
Secrets = Annotated[tuple[SecretStr, ...], NoDecode]


class Settings(BaseSettings):
    """The settings of one service. Lists are written with commas: `ULTRAGRAY_PRELOAD=liver,spine`."""

    model_config = SettingsConfigDict(env_prefix=ENVIRONMENT_PREFIX, extra="ignore", frozen=True)

    host: str = Field("127.0.0.1", min_length=1, description="Address that both servers listen on; 0.0.0.0 for all.")
    http_port: int = Field(8000, ge=0, le=65535, description="Port of HTTP; 0 takes a free one.")
    grpc_port: int = Field(50051, ge=0, le=65535, description="Port of gRPC; 0 takes a free one.")
    igtl_port: int | None = Field(
        None, ge=0, le=65535, description="Port of OpenIGTLink, usually 18944; 0 takes a free one; None: off."
    )
    igtl_scene: str | None = Field(
        None, description="Scene of OpenIGTLink devices whose names name none; None: the only one."
    )
    data_folder: Path = Field(Path("data"), description="Folder of the scene files (*.ugr). Must exist.")
    preload: Words = Field((), description="Scenes loaded before the service is ready.")

    processes: int = Field(
        0, ge=0, le=256, description="Render processes; 0: one per GPU that renders, on the CPU one."
    )
    threads_per_process: int = Field(0, ge=0, le=1024, description="Render threads each; 0: cores // processes.")
    backend: Literal["auto", "cpu", "cuda", "reference"] = Field(
        "auto", description="Render backend; auto: cuda where there is a GPU, else cpu."
    )
    queue_limit_frames: int = Field(256, ge=1, le=100_000, description="Frames that may wait; beyond: QUEUE_FULL.")
    max_batch_poses: int = Field(
        16, ge=1, le=MAX_BATCH_POSES, description="Poses of one scene that are rendered together."
    )
    memory_budget_mb: int = Field(
        4096, ge=16, le=16_777_216, description="MiB of scenes held by each process, on its GPU if it has one."
    )

    max_poses_per_request: int = Field(1024, ge=1, le=100_000, description="Poses in one request or batch.")
    max_image_side: int = Field(2048, ge=1, le=MAX_IMAGE_SIDE, description="Largest height and width, pixels.")
    max_request_pixels: int = Field(
        2**26,
        ge=1,
        le=2**28,
        description="Pixels that one answer may hold: poses x height x width x outputs.",
    )
    max_body_bytes: int = Field(8 * 2**20, ge=1024, le=2**30, description="Largest HTTP request body, bytes.")

    artifact_folder: Path | None = Field(
        None, description="Folder of datasets and jobs, shared with all workers; None: artifacts in data_folder."
    )
    max_dataset_bytes: int = Field(
        8 * 2**30,
        ge=1024,
        le=2**50,
        description="Largest upload: a scene file, or a dataset, packed and unpacked.",
    )
    dataset_memory_mb: int = Field(
        8192,
        ge=256,
        le=16_777_216,
        description="MiB that the check of an upload, or what the console shows of a dataset, may take; one at a time.",
    )
    upload_idle_timeout_s: float = Field(
        60.0, gt=0, le=3600, description="How long an upload may send nothing, seconds."
    )

    database_url: str | None = Field(
        None, description="PostgreSQL URL of the queue of jobs; None: a SQLite file in the artifact folder."
    )
    job_queue_limit: int = Field(1000, ge=1, le=100_000, description="Jobs that may wait; beyond: JOB_QUEUE_FULL.")
    embedded_worker: bool = Field(True, description="Whether `ultragray serve` starts a worker for jobs as well.")
    training_threads: int = Field(
        0, ge=0, le=1024, description="Threads of a job's process; 0: all cores but one, at least one."
    )
    job_nice: int = Field(10, ge=0, le=19, description="Nice level of a job's process; frames go first.")

    job_retention_days: float = Field(
        30.0, ge=0, le=36_500, description="Days that workers keep a finished job and its files; 0: for ever."
    )

    default_timeout_s: float = Field(30.0, gt=0, le=3600, description="Deadline of a request that names none, seconds.")
    drain_timeout_s: float = Field(
        10.0, ge=0, le=3600, description="How long waiting frames may take at a stop, seconds."
    )

    api_keys: Secrets = Field((), description="Where set, every request but health needs one of these keys.")
    cors_origins: Words = Field((), description="Origins whose pages may call HTTP; * for all.")
    log_level: Literal["debug", "info", "warning", "error"] = Field("info", description="Least level that is logged.")

    @property
    def artifacts(self) -> Path:
        """The artifact folder, resolved."""
        return self.data_folder / "artifacts" if self.artifact_folder is None else self.artifact_folder

    @field_validator("preload", "cors_origins", "api_keys", mode="before")
    @classmethod
    def _split_commas(cls, value: Any) -> Any:
        if isinstance(value, str):
            return tuple(word.strip() for word in value.split(",") if word.strip())
        return value

    @field_validator("api_keys")
    @classmethod
    def _refuse_short_keys(cls, keys: tuple[SecretStr, ...]) -> tuple[SecretStr, ...]:
        if any(len(key.get_secret_value()) < 16 for key in keys):
            raise ValueError("each key must have at least 16 characters")
        if not all(key.get_secret_value().isascii() for key in keys):
            raise ValueError("each key must be of ASCII characters, as gRPC carries no others")
        return keys


def load_settings(**overrides: Any) -> Settings:
    """Settings of the environment, `overrides` on top.

    Raises InvalidArgument that names the setting and its limits.
    """
    try:
        return Settings(**overrides)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        name = str(first["loc"][0]) if first["loc"] else "settings"
        given = "" if name == "api_keys" else f", got {first['input']!r}"
        raise InvalidArgument(
            f"{name} (environment variable {ENVIRONMENT_PREFIX}{name.upper()}): {first['msg']}{given}",
            field=name,
        ) from None
