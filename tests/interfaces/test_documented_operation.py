"""Settings, commands, metrics, logs and limits, as docs/interfaces.md lists them."""

from __future__ import annotations

import json
import logging
import math
import sys
from datetime import datetime, timezone

import numpy as np
import pytest
import typer
from opentelemetry import trace

from ultragray import ConvexProbe, LinearProbe, errors, image_size, pose, scene_info
from ultragray.probe import fan, probe
from ultragray.settings import Resolved
from ultragray.training.config import PRESETS, TrainingConfig
from ultragray_service.cli.app import app as command_line
from ultragray_service.cli.group import INTERRUPTED, USER_ERROR
from ultragray_service.cli.remote.watch import JOB_CANCELLED, JOB_FAILED
from ultragray_service.core import catalog, dataset_uploads
from ultragray_service.core.state import Service
from ultragray_service.core.streams import pose_stream
from ultragray_service.errors import STATUSES
from ultragray_service.listening import http_server
from ultragray_service.rpc import server as grpc_server
from ultragray_service.rpc import shared_memory
from ultragray_service.settings import LEAST_KEY_LENGTH, load_settings
from ultragray_service.telemetry.logs import JsonFormatter, request_id
from ultragray_service.tls.certificates import HANDSHAKE_TIMEOUT_S
from ultragray_workers import scenes
from ultragray_workers.datasets import store as dataset_store
from ultragray_workers.datasets import unpack as dataset_unpack
from ultragray_workers.errors import QueueFull
from ultragray_workers.jobs.job import JobState
from ultragray_workers.jobs.overview import JobsOverview
from ultragray_workers.jobs.queue.attendance import WorkerState
from ultragray_workers.pool.process import encoding as pixels
from ultragray_workers.pool.types import RenderResult

from .document import code, rows, table


def test_command_line() -> None:
    commands = dict(typer.main.get_command(command_line).commands)  # type: ignore[attr-defined]
    assert list(table("Command line")) == list(commands)
    while groups := [name for name in commands if hasattr(commands[name], "commands")]:
        name = groups[0]
        group = commands.pop(name)
        commands |= {f"{name} {command}": value for command, value in group.commands.items()}
    for name, command in commands.items():
        documented = [code(first) for first, _ in rows(f"ultragray {name}")]
        assert documented == [
            [parameter.name.upper()] if parameter.param_type_name == "argument" else list(parameter.opts)
            for parameter in command.params
        ], name


def test_training_settings() -> None:
    presets = [TrainingConfig.preset(name).to_dict() for name in PRESETS]
    documented = {
        name: [json.loads(code(cell)[0]) for cell in cells[: len(presets)]]
        for name, cells in table("Training settings").items()
    }
    assert documented == {name: [preset[name] for preset in presets] for name in presets[0]}


def test_exit_codes() -> None:
    assert set(table("Exit codes")) == {"0", "1", *map(str, (USER_ERROR, JOB_FAILED, JOB_CANCELLED, INTERRUPTED))}


def rendered() -> RenderResult:
    settings = Resolved(LinearProbe(width_mm=40, near_mm=0, far_mm=40), 16, 16)
    poses = np.eye(4)[None]
    return RenderResult("demo", "0" * 64, "reference", settings, poses, b"", 1.0, 1.0, 1.0, (), 1)


def test_metrics(service: Service) -> None:
    service.metrics.count_request("http", "/", "200", 0.1)
    service.metrics.count_frame_error(QueueFull("all places are taken"))
    service.metrics.observe_result(rendered())
    service.metrics.count_limited("streams")
    service.metrics.tell_certificate_expiry(lambda: datetime(2030, 1, 1, tzinfo=timezone.utc))
    service.jobs.overview = JobsOverview({JobState.QUEUED: 1}, {WorkerState.IDLE: 1})
    found = {}
    for metric in service.metrics.registry.collect():
        if not metric.name.startswith("process_"):
            suffix = "_total" if metric.type == "counter" else ""
            labels = {label for sample in metric.samples for label in sample.labels} - {"le"}
            found[metric.name + suffix] = (metric.type, labels)
    assert {name: (kind, set(code(labels))) for name, (kind, labels, _) in table("Metrics").items()} == found


def test_logs() -> None:
    token = request_id.set("one")
    span = trace.NonRecordingSpan(trace.SpanContext(1, 1, is_remote=False))
    try:
        raise ValueError("no")
    except ValueError:
        record = logging.LogRecord("ultragray", logging.INFO, "", 0, "text", (), sys.exc_info())
        with trace.use_span(span):
            assert list(table("Logs")) == list(json.loads(JsonFormatter().format(record)))
    finally:
        request_id.reset(token)


def test_fixed_limits() -> None:
    documented = {cells[0]: code(cells[1])[0] for cells in rows("Fixed limits")}
    assert documented.pop("Scene names") == scenes._NAME.pattern
    assert documented.pop("Dataset names") == dataset_store._NAME.pattern
    assert {name: float(value) for name, value in documented.items()} == {
        "Rotation tolerance": pose.ROTATION_TOLERANCE,
        "Largest coordinate of a pose": pose.MAX_POSITION_MM,
        "Largest length of a probe": probe.MAX_LENGTH_MM,
        "Largest opening angle": fan.LARGEST_OPENING_DEG,
        "Largest height and width of the library": image_size.MAX_IMAGE_SIDE,
        "Height and width where the scene knows none": image_size.DEFAULT_IMAGE_SIDE,
        "Training poses of a scene": scene_info.MAX_TRAINING_POSES,
        "Header of a scene file, with its metadata": scene_info.MAX_HEADER_BYTES,
        "Metrics of a scene": scene_info.MAX_METRICS,
        "Largest spherical-harmonic degree": scene_info.MAX_SH_DEGREE,
        "Scenes on one page, default": catalog.DEFAULT_PAGE_SIZE,
        "Scenes on one page": catalog.MAX_PAGE_SIZE,
        "Datasets on one page, default": catalog.DEFAULT_PAGE_SIZE,
        "Datasets on one page": catalog.MAX_PAGE_SIZE,
        "Uploads at the same time": dataset_uploads.MAX_UPLOADS,
        "Files of a dataset": dataset_unpack.MAX_FILES,
        "Check of a dataset": dataset_uploads.CHECK_TIMEOUT_S,
        "Frames in flight in one ordered stream": pose_stream.MAX_FRAMES_IN_FLIGHT,
        "Bytes of these frames, if there are several": pose_stream.MAX_BYTES_IN_FLIGHT,
        "Frames in the window of a latest stream": pose_stream.MAX_WINDOW,
        "Memory that one stream shares": shared_memory.MAX_BYTES,
        "Message to a WebSocket": http_server.MAX_STREAM_MESSAGE_BYTES,
        "gRPC message received, where `ULTRAGRAY_MAX_BODY_BYTES` is less": grpc_server.LEAST_MAX_MESSAGE_BYTES,
        "Keepalive pings of a gRPC client, no more often than every": grpc_server.LEAST_PING_INTERVAL_MS,
        "TLS handshake": HANDSHAKE_TIMEOUT_S,
        "JPEG quality": pixels.JPEG_QUALITY,
        "Retry after": STATUSES["QUEUE_FULL"].retry_after_s,
        "Shortest API key": LEAST_KEY_LENGTH,
    }
    ConvexProbe(fan.LARGEST_OPENING_DEG, 1, 2)
    with pytest.raises(errors.InvalidProbe):
        ConvexProbe(math.nextafter(fan.LARGEST_OPENING_DEG, 180), 1, 2)
    load_settings(api_keys="k" * LEAST_KEY_LENGTH)
    with pytest.raises(errors.InvalidArgument):
        load_settings(api_keys="k" * (LEAST_KEY_LENGTH - 1))
