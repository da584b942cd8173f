"""Settings of the service, with units, defaults and limits: environment variables ULTRAGRAY_ + upper-case name."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ultragray.contract import Contract, annotated_fields, described, from_text
from ultragray.errors import InvalidArgument
from ultragray.geometry.image_size import MAX_IMAGE_SIDE
from ultragray.geometry.probe import MAX_THICKNESS_MM
from ultragray_service.access.oidc import check_url, parse_roles
from ultragray_service.access.principals import NAMES, Allowance, parse_allowed
from ultragray_service.environment import PREFIX
from ultragray_workers.jobs.kinds.base import MAX_RUN_S
from ultragray_workers.pool.messages import PoolConfig
from ultragray_workers.storage.location import Location, StorageUrl, parse_location

ENVIRONMENT_PREFIX = PREFIX
LEAST_KEY_LENGTH = 16
LOG_FORMATS = ("auto", "human", "json")
ADDRESSES, TLS, INSTALLATION, COMPUTE, LOGS = "Addresses", "TLS", "Installation", "Compute", "Logs"  # topics
_MAX_MB = 16_777_216
_HOUR_S = 3600.0


def like(cls: type[Contract], name: str, **changes: Any) -> Any:
    """A setting that means what the field `name` of another contract does."""
    (item,) = (item for item, _ in annotated_fields(cls) if item.name == name)
    return field(**{"default": item.default, "metadata": item.metadata, **changes})


@dataclass(frozen=True, kw_only=True)
class Settings(Contract):
    """The settings of one service. Lists are written with commas: `ULTRAGRAY_PRELOAD=liver,spine`."""

    host: str = described(
        "Address that all servers listen on; 0.0.0.0 for all. Others than this machine's own need API keys.",
        "127.0.0.1",
        topic=ADDRESSES,
    )
    http_port: int = described(
        "Port of HTTP; 0 takes a free one, which the log tells.", 8000, low=0, high=65535, topic=ADDRESSES
    )
    grpc_port: int = described("Port of gRPC; 0 takes a free one.", 50051, low=0, high=65535, topic=ADDRESSES)
    igtl_port: int | None = described(
        "Port of OpenIGTLink, usually 18944; 0 takes a free one; none: off.", None, low=0, high=65535, topic=ADDRESSES
    )
    igtl_scene: str | None = described("Scene of OpenIGTLink devices whose names name none; none: the only one.", None)
    igtl_registration: str | None = described(
        "Registration that leads the poses of OpenIGTLink devices, marker to tracker, into its scene, which the "
        "device or igtl_scene names where there are several; none: they are probe to scene.",
        None,
    )
    igtl_slice_thickness_mm: float | None = described(
        "Of frames over OpenIGTLink, mm: full width at half maximum along elevation at the focus of the scene's beam; "
        "0: a plane; none: as trained.",
        None,
        low=0.0,
        high=MAX_THICKNESS_MM,
    )
    igtl_allow: tuple[str, ...] = described(
        "Other machines that may use OpenIGTLink, which has neither keys nor TLS: addresses or networks with a role, "
        "such as 10.0.0.7=reader; none: this machine alone.",
        (),
    )
    tls_certificate: Path | None = described(
        "PEM file of the server's certificate, then those of intermediate authorities: HTTP and gRPC speak TLS, and "
        "nothing else. None: no TLS.",
        None,
        topic=TLS,
    )
    tls_key: Path | None = described("PEM file of the certificate's key, not encrypted.", None, topic=TLS)
    tls_client_ca: Path | None = described(
        "PEM file of authorities: a client must present a certificate that one of them signed (mutual TLS).",
        None,
        topic=TLS,
    )
    data_folder: Location = described(
        "Existing folder of the scene files (*.ugr), or the URL of a bucket that holds them: s3://BUCKET/PREFIX, "
        "gs://, az://, with what the URL does not say in AWS_*, GOOGLE_* or AZURE_* variables. `ultragray serve` makes "
        "the default one, and puts the demo scene where there is none.",
        Path("data"),
        topic=INSTALLATION,
    )
    scene_list_max_age_s: float = described(
        "How long scenes of a bucket are served from the cache, as they were listed last, while it does not answer.",
        _HOUR_S,
        low=1.0,
        high=24 * _HOUR_S,
    )
    preload: tuple[str, ...] = described("Scenes that are loaded before the service is ready.", ())

    processes: int = like(PoolConfig, "processes")
    threads_per_process: int = like(PoolConfig, "threads_per_process")
    backend: str = described(
        "Render backend; auto: cuda where there is a GPU, else cpu.",
        "auto",
        choices=("auto", "cpu", "cuda", "reference"),
        topic=COMPUTE,
    )
    queue_limit_frames: int = like(PoolConfig, "queue_limit_frames")
    client_limit_frames: int = like(PoolConfig, "client_limit_frames", default=128)
    max_queue_ms: float = like(PoolConfig, "max_queue_ms")
    max_batch_poses: int = like(PoolConfig, "max_batch_poses")
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
    max_footprint_pixels: int = like(PoolConfig, "max_footprint_pixels")
    max_body_bytes: int = described(
        "Largest HTTP request body and gRPC message; of gRPC at least 2 MiB, for the chunks of uploads.",
        8 * 2**20,
        low=1024,
        high=2**30,
    )

    artifact_folder: Location | None = described(
        "Folder of datasets, jobs and the scenes that they make, which all services and workers share, or the URL of a "
        "bucket, which needs database_url; none: artifacts in the data folder.",
        None,
        topic=INSTALLATION,
    )
    cache_folder: Path | None = described(
        "Folder of this host for what is fetched from a bucket, and for what is under way; none: ultragray in the "
        "user's folder of caches.",
        None,
        topic=INSTALLATION,
    )
    max_cache_bytes: int = described(
        "Bytes of fetched objects in it, of all processes together; the least recently used goes.",
        20 * 2**30,
        low=2**20,
        high=2**50,
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

    max_connections: int = described(
        "Connections to each of HTTP, gRPC and OpenIGTLink; the process may open about three times as many files.",
        2048,
        low=1,
        high=1_000_000,
    )
    max_connections_per_address: int = described(
        "Those of one address; behind a proxy, whose connections all have its address, as many as in all.",
        256,
        low=1,
        high=1_000_000,
    )
    max_header_bytes: int = described(
        "Request line and headers of an HTTP request, or metadata of a call of gRPC.", 64 * 1024, low=8192, high=2**20
    )
    max_headers: int = described("Headers of an HTTP request.", 128, low=16, high=10_000)
    header_timeout_s: float = described("How long the head of an HTTP request may take.", 10.0, above=0.0, high=_HOUR_S)
    idle_timeout_s: float = described(
        "How long a connection to HTTP or gRPC may stay open without a request.", 75.0, low=1.0, high=_HOUR_S
    )
    min_bytes_per_s: float = described(
        "Least rate at which a client sends a body and takes an answer.", 1024.0, above=0.0, high=2.0**40
    )
    transfer_patience_s: float = described("How long it may do less before it is cut off.", 30.0, low=1.0, high=_HOUR_S)

    database_url: str | None = described(
        "PostgreSQL URL of the queue of jobs; none: a SQLite file in the artifact folder.",
        None,
        repr=False,
        topic=INSTALLATION,
    )
    job_queue_limit: int = described("Jobs that may wait; beyond: JOB_QUEUE_FULL.", 1000, low=1, high=100_000)
    ready_without_jobs: bool = described(
        "Whether the service is ready as soon as it renders, even where the jobs' database or the artifact folder is "
        "away.",
        False,
    )
    embedded_worker: bool = described("Whether `ultragray serve` starts a worker for jobs as well.", True)
    training_threads: int = described(
        "Threads of a job's process; 0: all cores but one, at least one.", 0, low=0, high=1024, topic=COMPUTE
    )
    job_nice: int = described(
        "Nice level of jobs and of the worker within the service: frames go first.", 10, low=0, high=19
    )
    job_stall_timeout_s: float = described(
        "Time in which the process of a job must get on (compute, read or write), or it is ended: JOB_STALLED; 0: any.",
        120.0,
        low=0.0,
        high=_HOUR_S,
    )
    job_max_run_s: float = described(
        "Longest time that a job may run in all, whatever its max_run_s: JOB_TIME_EXCEEDED; 0: any.",
        2 * 86_400.0,
        low=0.0,
        high=MAX_RUN_S,
    )
    job_drain_timeout_s: float = described(
        "How long a worker that stops lets a job go on that would begin anew elsewhere; trainings go back at once.",
        10.0,
        low=0.0,
        high=_HOUR_S,
    )
    job_retention_days: float = described(
        "Days after which workers remove a finished job with its files (the scene that it trained stays); 0: never.",
        30.0,
        low=0.0,
        high=36_500.0,
    )

    default_timeout_s: float = described("Deadline of a request that names none.", 30.0, above=0.0, high=_HOUR_S)
    worker_grace_s: float = like(PoolConfig, "worker_grace_s")
    worker_timeout_s: float = like(PoolConfig, "worker_timeout_s")
    drain_delay_s: float = described(
        "How long a service that is told to stop goes on as before but for its readiness: behind a proxy, longer than "
        "that takes to notice and to send what is new elsewhere.",
        0.0,
        low=0.0,
        high=_HOUR_S,
    )
    drain_timeout_s: float = described("How long frames that wait may take at a stop.", 10.0, low=0.0, high=_HOUR_S)

    api_keys: tuple[str, ...] = described(
        f"Keys of at least {LEAST_KEY_LENGTH} ASCII characters; where set, every request but health and documentation "
        "needs one.",
        (),
        repr=False,
    )
    oidc_issuer: str | None = described(
        "URL of an OpenID Connect issuer, as tokens name it: they are taken beside API keys; none: no tokens.", None
    )
    oidc_audience: str | None = described("Audience that tokens must be for, usually this service's client id.", None)
    oidc_role_claim: str = described("Claim that gives roles; dots lead inwards: realm_access.roles.", "roles")
    oidc_roles: tuple[str, ...] = described(
        "Values of that claim with the role that each gives, such as ultragray-admin=admin,radiology=reader.", ()
    )
    oidc_name_claim: str = described(
        "Claim that says whose a token is; its values must never go to somebody else.", "sub"
    )
    oidc_client_id: str | None = described(
        "Client id of the console at the issuer, a public client: people sign in with their browser; none: with keys.",
        None,
    )
    oidc_scope: str = described("Scopes that the console asks the issuer for.", "openid profile")
    oidc_ca: Path | None = described(
        "PEM file of authorities that sign the issuer's certificate; none: those that the system trusts.", None
    )
    key_requests_per_s: int | None = like(Allowance, "requests_per_s")
    key_frames_per_s: int | None = like(Allowance, "frames_per_s")
    key_streams: int | None = like(Allowance, "streams")
    key_unfinished_jobs: int | None = like(Allowance, "unfinished_jobs")
    key_running_jobs: int | None = like(Allowance, "running_jobs")
    key_compute_minutes_per_day: float | None = like(Allowance, "compute_minutes_per_day")
    key_stored_gb: float | None = like(Allowance, "stored_gb")
    key_registrations: int | None = like(Allowance, "registrations")
    insecure: bool = described(
        "Whether other machines are served even without any API key: whoever reaches the address is an admin.",
        False,
        topic=ADDRESSES,
    )
    allowed_hosts: tuple[str, ...] = described(
        "Names of this machine in URLs, beside localhost and its addresses: without API keys others are refused; * for "
        "all.",
        (),
    )
    cors_origins: tuple[str, ...] = described(
        "Origins of other sites, such as https://app.example, whose pages may use the service; * for all.", ()
    )
    log_format: str = described(
        "human: a line for people; json: an object a line; auto: human on a terminal, else json.",
        "auto",
        choices=LOG_FORMATS,
        topic=LOGS,
    )
    log_level: str = described(
        "Least level that is logged.", "info", choices=("debug", "info", "warning", "error"), topic=LOGS
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("data_folder", "artifact_folder"):
            if (location := getattr(self, name)) is not None:
                object.__setattr__(self, name, parse_location(location, name))
        if isinstance(self.artifacts, StorageUrl) and self.database_url is None:
            raise InvalidArgument(
                "database_url must name a PostgreSQL database where datasets and jobs are in a bucket "
                f"({self.artifacts}): SQLite is a file of one host",
                field="database_url",
            )
        if not self.host:
            raise InvalidArgument("host must be an address, got none", field="host")
        parse_allowed(self.igtl_allow)
        if (self.tls_certificate is None) is not (self.tls_key is None):
            missing = "tls_key" if self.tls_key is None else "tls_certificate"
            raise InvalidArgument(f"{missing} must be given too: TLS needs a certificate and its key", field=missing)
        if self.tls_client_ca is not None and self.tls_certificate is None:
            raise InvalidArgument("tls_client_ca needs tls_certificate and tls_key", field="tls_client_ca")
        parse_roles(self.oidc_roles)
        if self.oidc_issuer is not None:
            check_url(self.oidc_issuer, "oidc_issuer")
            for name in ("oidc_audience", "oidc_roles"):
                if not getattr(self, name):
                    raise InvalidArgument(f"{name} must be given too, beside oidc_issuer", field=name)
        elif self.oidc_client_id is not None:
            raise InvalidArgument("oidc_client_id needs oidc_issuer", field="oidc_client_id")
        if any(len(key) < LEAST_KEY_LENGTH for key in self.api_keys):
            raise InvalidArgument(f"api_keys must have at least {LEAST_KEY_LENGTH} characters each", field="api_keys")
        if not all(key.isascii() for key in self.api_keys):
            raise InvalidArgument("api_keys must be of ASCII characters, as gRPC carries no others", field="api_keys")

    @property
    def allowance(self) -> Allowance:
        return Allowance(**{name: getattr(self, f"key_{name}") for name in NAMES})

    @property
    def artifacts(self) -> Location:
        """Where datasets and jobs are: the artifact folder, or that within the data folder."""
        if self.artifact_folder is not None:
            return self.artifact_folder
        return _below(self.data_folder, "artifacts")

    @property
    def working_folder(self) -> Path:
        """The folder of this host for locks and for what is under way: the artifact folder, where that is one."""
        if isinstance(self.artifacts, Path):
            return self.artifacts
        return self.cache / "work" / hashlib.sha256(str(self.artifacts).encode()).hexdigest()[:16]

    @property
    def is_there(self) -> bool:
        return any(not isinstance(one, Path) or one.is_dir() for one in (self.artifacts, self.data_folder))

    @property
    def cache(self) -> Path:
        if self.cache_folder is not None:
            return self.cache_folder
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ultragray"


def _below(location: Location, name: str) -> Location:
    return location / name if isinstance(location, Path) else location.below(name)


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
        full_name = f"{name} (environment variable {ENVIRONMENT_PREFIX}{name.upper()})"
        raise InvalidArgument(error.detail.replace(name, full_name, 1), field=name) from None
