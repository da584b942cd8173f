"""Parts about what the product defines: outputs, formats, settings, limits, errors, metrics."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import MISSING, Field
from datetime import datetime, timezone
from typing import Any

import numpy as np
from prometheus_client.metrics_core import Metric

from ultragray import LinearProbe, errors
from ultragray.contract import annotated_fields, limits_in_words, range_of, to_dict
from ultragray.exchange.exports import FORMATS
from ultragray.geometry import image_size, pose, probe
from ultragray.learn.training.config import PRESETS, TrainingConfig
from ultragray.rendering import pixels
from ultragray.rendering.outputs import OUTPUTS
from ultragray.rendering.settings import Resolved
from ultragray.rendering.tools import MAX_TOOLS
from ultragray.samplers import Sampler
from ultragray.scene import info as scene_info
from ultragray.scene.confidence import FIGURES
from ultragray_client import errors as client_errors
from ultragray_service import errors as service_errors
from ultragray_service.core import scenes as catalog
from ultragray_service.core import streams as pose_stream
from ultragray_service.core import uploads as dataset_uploads
from ultragray_service.errors import STATUSES, statuses_of
from ultragray_service.igtl import connection
from ultragray_service.igtl import frames as waiting
from ultragray_service.rpc import server as grpc_server
from ultragray_service.rpc import shared_memory
from ultragray_service.service import Service
from ultragray_service.settings import ENVIRONMENT_PREFIX, LEAST_KEY_LENGTH, Settings
from ultragray_service.tls import HANDSHAKE_TIMEOUT_S
from ultragray_studies.methods.registry import METHODS
from ultragray_workers import errors as workers_errors
from ultragray_workers import scene_names
from ultragray_workers.datasets import store as dataset_store
from ultragray_workers.datasets import unpack as dataset_unpack
from ultragray_workers.errors import QueueFull
from ultragray_workers.jobs.demand import AUTO
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.store import JobsOverview
from ultragray_workers.jobs.workers import WorkerState
from ultragray_workers.pool.messages import RenderResult

from .interfaces import temporary_service
from .markdown import code, codes, in_line, summary, table


def outputs() -> str:
    rows = ((code(one.name), in_line(one.meaning), one.range_in_words) for one in OUTPUTS.values())
    return table(("Output", "Meaning", "Pixels"), rows)


def formats() -> str:
    rows = (
        (
            code(one.name),
            code(one.suffix),
            codes(one.dtypes),
            code(one.extra) if one.extra else "",
            in_line(one.meaning),
        )
        for one in FORMATS.values()
    )
    return table(("Format", "Suffix", "Pixels, the default first", "Extra", "Holds"), rows)


def npz() -> str:
    frames = [(code(one.name), code(one.dtype.name), "`[C, H, W]`", "If requested") for one in OUTPUTS.values()]
    figures = [(code(name), "`float32`", "`[C]`", "Confidence figure; NaN if unknown") for name in FIGURES]
    rows = [
        *frames,
        ("`poses`", "`float64`", "`[C, 4, 4]`", "Poses as used, mm"),
        *figures,
        ("`scene`", "`str`", "`[]`", "Name of the scene"),
        ("`scene_sha256`", "`str`", "`[]`", "SHA-256 of the scene file"),
        ("`renderer`", "`str`", "`[]`", "Name, version and backend, such as `ultragray/0.1.0 cpu-avx512`"),
    ]
    return table(("Key", "Type", "Shape", "Meaning"), rows)


def samplers() -> str:
    rows = []
    for kind, cls in Sampler.members.items():
        keys = (
            code(item.name) if item.default is MISSING else f"{code(item.name)} {code(default_of(item))}"
            for item, _ in annotated_fields(cls)
            if item.name != "kind"
        )
        rows.append((code(kind), ", ".join(keys), summary(cls)))
    return table(("Kind", "Keys with their defaults", "Poses"), rows)


def methods() -> str:
    """A section for each method, as it describes itself."""
    sections = []
    for name, method in METHODS.items():
        told = method.describe()
        recipe = "" if told.published_steps is None else f" Author's recipe: {told.published_steps:,} steps."
        sections += [f"### {told.title}: {code(name)}", "", f"{told.summary} Source: {told.source}.{recipe}", ""]
        if told.equations:
            sections += ["```text", *told.equations, "```", ""]
        sections += [*(f"- {choice}" for choice in told.choices), ""]
    return "\n".join(sections).rstrip()


def training_settings() -> str:
    presets = {name: TrainingConfig.preset(name).to_dict() for name in PRESETS}
    rows = (
        (
            code(item.name),
            *(code(_short(settings[item.name])) for settings in presets.values()),
            described(item),
        )
        for item, _ in annotated_fields(TrainingConfig)
    )
    return table(("Setting", *map(code, presets), "Meaning"), rows)


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else json.dumps(value)


def keys(cls: type[Any], head: str = "Key") -> str:
    """The fields of a class of the contract, with their defaults."""
    rows = ((code(item.name), code(default_of(item)), described(item)) for item, _ in annotated_fields(cls))
    return table((head, "Default", "Meaning"), rows)


def told(cls: type[Any], head: str = "Key") -> str:
    """The fields of a class of which only answers are made."""
    return table((head, "Meaning"), ((code(item.name), described(item)) for item, _ in annotated_fields(cls)))


def default_of(item: Field[Any]) -> str:
    if item.default_factory is not MISSING:
        return json.dumps(to_dict(item.default_factory()))
    return "required" if item.default is MISSING else json.dumps(to_dict(item.default))


def described(item: Field[Any]) -> str:
    parts = (in_line(item.metadata.get("description", "")), limits_in_words(item))
    return ". ".join(part for part in parts if part)


# Limits that no setting changes: each row names the constant that holds it.

_HEAD = ("Limit", "Value")


def fixed_limits() -> str:
    rows = [
        ("Name of a scene", code(scene_names._NAME.pattern)),
        ("Name of a dataset", code(dataset_store._NAME.pattern)),
        ("Deviation from a rotation that is corrected", f"{pose.ROTATION_TOLERANCE:g}"),
        ("Coordinate of a pose", f"{pose.MAX_POSITION_MM:,.0f} mm"),
        ("Length of a probe", f"{probe.MAX_LENGTH_MM:,.0f} mm"),
        ("Tools of a frame", f"{MAX_TOOLS}"),
        ("Opening angle of a fan", f"{probe.LARGEST_OPENING_DEG:g}°"),
        ("Height and width of a frame (library)", f"{image_size.MAX_IMAGE_SIDE:,}"),
        ("Height and width if the scene does not know them", f"{image_size.DEFAULT_IMAGE_SIDE:,}"),
        ("Training poses of a scene", f"{scene_info.MAX_TRAINING_POSES:,}"),
        ("Header of a scene file, metadata included", _bytes(scene_info.MAX_HEADER_BYTES)),
        ("Metrics of a scene", f"{scene_info.MAX_METRICS:,}"),
        ("Degree of the spherical harmonics", f"{scene_info.MAX_SH_DEGREE}"),
        ("Entries on one page of a list", f"{catalog.MAX_PAGE_SIZE:,}, by default {catalog.DEFAULT_PAGE_SIZE}"),
        ("Uploads at the same time", f"{dataset_uploads.MAX_UPLOADS}"),
        ("Files of a dataset", f"{dataset_unpack.MAX_FILES:,}"),
        ("Time to check a dataset", f"{dataset_uploads.DATASET_CHECK_TIMEOUT_S:,} s"),
        ("Frames in flight in an ordered stream", f"{pose_stream.MAX_FRAMES_IN_FLIGHT}"),
        ("Their bytes, if there are several", _bytes(pose_stream.MAX_BYTES_IN_FLIGHT)),
        ("Window of a latest stream", f"{pose_stream.MAX_WINDOW} frames"),
        ("Memory that a stream shares", _bytes(shared_memory.MAX_BYTES)),
        ("Message to the WebSocket, or through a socket of the host", _bytes(pose_stream.MAX_MESSAGE_BYTES)),
        ("gRPC message, if `ULTRAGRAY_MAX_BODY_BYTES` is less", _bytes(grpc_server.LEAST_MAX_MESSAGE_BYTES)),
        ("Time between keepalive pings of a gRPC client, at least", f"{grpc_server.LEAST_PING_INTERVAL_MS:,} ms"),
        ("TLS handshake", f"{HANDSHAKE_TIMEOUT_S:g} s"),
        ("Quality of a JPEG", f"{pixels.JPEG_QUALITY}"),
        ("`Retry-After` of a full queue", f"{STATUSES['QUEUE_FULL'].retry_after_s:g} s"),
        ("Length of an API key, at least", f"{LEAST_KEY_LENGTH} characters"),
    ]
    return table(_HEAD, rows)


def igtl_limits() -> str:
    rows = [
        ("Devices of a client that wait for their frames", f"{waiting.MAX_WAITING_DEVICES}"),
        ("Content of a message that is read", _bytes(connection.MAX_BODY_BYTES)),
        ("Content of any message; more is skipped", _bytes(connection.MAX_SKIPPED_BYTES)),
        ("Time from the first byte of a message to its last", f"{connection.MESSAGE_TIMEOUT_S:g} s"),
        ("Time that a client may take nothing", f"{connection.SEND_TIMEOUT_S:g} s"),
    ]
    return table(_HEAD, rows)


def _bytes(number: int) -> str:
    for unit, size in (("MiB", 2**20), ("KiB", 2**10)):
        if number % size == 0:
            return f"{number // size:,} {unit}"
    return f"{number:,} bytes"


# Of the service: settings, errors, metrics.


def settings() -> str:
    rows = []
    for item, _ in annotated_fields(Settings):
        default = "" if item.default in (None, ()) else code(item.default)
        limits = codes(item.metadata.get("choices", ())) or range_of(item).strip()
        name = code(f"{ENVIRONMENT_PREFIX}{item.name.upper()}")
        rows.append((name, default, limits, in_line(str(item.metadata["description"]))))
    return table(("Variable", "Default", "Limits", "Meaning"), rows)


def error_reasons() -> str:
    """The errors of each package, in their order there."""

    def rows() -> Iterator[tuple[str, ...]]:
        for module in (errors, workers_errors, service_errors):
            for cls in errors.error_classes():
                if cls.__module__ == module.__name__:
                    kind = "↳ " if cls.__base__ is errors.InvalidArgument else ""
                    told = statuses_of(cls)
                    name = f"{kind}{code(cls.__name__)}"
                    yield code(cls.reason), name, code(module.__name__), str(told.http), told.grpc, summary(cls)

    return table(("Reason", "Class", "Module", "HTTP", "gRPC", "Meaning"), rows())


def client_error_reasons() -> str:
    rows = ((code(one.reason), code(one.__name__), code(one.__mro__[1].__name__)) for one in client_errors.ERRORS)
    return table(("Reason", "Class", "Kind of"), rows)


def metrics() -> str:
    """The metrics of a service at which everything was counted once."""
    with temporary_service() as service:
        _count_everything(service)
        found = [one for one in service.metrics.registry.collect() if not one.name.startswith("process_")]
    rows = (
        (
            code(one.name + ("_total" if one.type == "counter" else "")),
            one.type,
            codes(_labels(one)),
            in_line(one.documentation),
        )
        for one in found
    )
    return table(("Metric", "Type", "Labels", "Meaning"), rows)


def _labels(metric: Metric) -> list[str]:
    return list(dict.fromkeys(label for sample in metric.samples for label in sample.labels if label != "le"))


def _count_everything(service: Service) -> None:
    poses = np.eye(4)[None]
    resolved = Resolved(LinearProbe(width_mm=40, near_mm=0, far_mm=40), 16, 16)
    service.metrics.count_request("http", "/", "200", 0.1)
    service.metrics.count_frame_error(QueueFull("all places are taken"))
    service.metrics.observe_result(
        RenderResult("demo", "0" * 64, "reference", resolved, poses, b"", 1.0, 1.0, 1.0, (), 1)
    )
    service.metrics.count_limited("streams")
    service.metrics.tell_certificate_expiry(lambda: datetime(2030, 1, 1, tzinfo=timezone.utc))
    service.jobs.overview = JobsOverview({JobState.QUEUED: 1}, {WorkerState.IDLE: 1}, {AUTO: 1.0})
