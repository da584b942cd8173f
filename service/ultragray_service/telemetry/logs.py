"""Logs and traces: structured lines with the id of the request, and spans for an OpenTelemetry collector."""

from __future__ import annotations

import json
import logging
import os
import re
import sys
import time
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import datetime, timezone
from typing import Any

from opentelemetry import propagate, trace

from ultragray import __version__
from ultragray.errors import InvalidArgument
from ultragray.installation import missing_extra
from ultragray_workers.pool.messages import RenderResult

request_id: ContextVar[str] = ContextVar("request_id", default="")

_DIM, _RED, _YELLOW = 2, 31, 33  # of ANSI
_ACCEPTED_REQUEST_ID = re.compile(r"[A-Za-z0-9._:/+=-]{1,128}")


def choose_request_id(offered: str | None) -> str:
    if offered and _ACCEPTED_REQUEST_ID.fullmatch(offered):
        return offered
    return uuid.uuid4().hex


class JsonFormatter(logging.Formatter):
    """A record as one line of JSON; `extra={"fields": {...}}` adds keys."""

    def format(self, record: logging.LogRecord) -> str:
        document = {
            "time": datetime.fromtimestamp(record.created, timezone.utc).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        if current := request_id.get():
            document["request_id"] = current
        if (span := trace.get_current_span().get_span_context()).is_valid:
            document["trace_id"] = trace.format_trace_id(span.trace_id)
        document.update(getattr(record, "fields", {}))
        if record.exc_info:
            document["exception"] = self.formatException(record.exc_info)
        return json.dumps(document, ensure_ascii=False, default=str)


class HumanFormatter(logging.Formatter):
    """A record as a line for people: the time of day, the level where it is not usual, and the sentence."""

    def __init__(self, *, in_colour: bool) -> None:
        super().__init__()
        self._in_colour = in_colour

    def format(self, record: logging.LogRecord) -> str:
        time = datetime.fromtimestamp(record.created).astimezone().strftime("%H:%M:%S")
        level = "" if record.levelno == logging.INFO else f"{record.levelname.lower()}: "
        if record.levelno >= logging.WARNING:
            level = self._coloured(level, _YELLOW if record.levelno == logging.WARNING else _RED)
        sentence = "".join(
            one if one.isprintable() else ascii(one)[1:-1] for one in _sentence(record)
        )  # paths are theirs
        line = f"{self._coloured(time, _DIM)} {level}{sentence}"
        return f"{line}\n{self.formatException(record.exc_info)}" if record.exc_info else line

    def _coloured(self, text: str, code: int) -> str:
        return f"\x1b[{code}m{text}\x1b[0m" if self._in_colour else text


def _sentence(record: logging.LogRecord) -> str:
    fields = getattr(record, "fields", {})
    if "duration_ms" not in fields:
        return record.getMessage()
    what = " ".join(str(fields[name]) for name in ("method", "path") if name in fields)
    return f"{what}: {fields['status']} in {fields['duration_ms']:.0f} ms"


def is_for_people(log_format: str) -> bool:
    return log_format == "human" or (log_format == "auto" and sys.stderr.isatty())


def configure_logging(level: str, log_format: str = "json") -> None:
    """Send every logger of the process, uvicorn's and grpc's included, through one handler.

    `log_format`: `human`, `json`, or `auto` as `is_for_people` decides.
    """
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        HumanFormatter(in_colour=sys.stderr.isatty()) if is_for_people(log_format) else JsonFormatter()
    )
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level.upper())
    logging.getLogger("uvicorn").setLevel(max(logging.WARNING, root.level))
    # It says so of each WebSocket that was refused with an answer, which anyone could fill the log with.
    logging.getLogger("uvicorn.error").addFilter(
        lambda record: record.getMessage() != "ASGI callable returned without completing handshake."
    )


# Traces of OpenTelemetry: a span for each request, and below it those of the render pool.
# `OTEL_EXPORTER_OTLP_ENDPOINT` turns them on; the other standard variables (OTEL_SERVICE_NAME, OTEL_TRACES_SAMPLER,
# OTEL_EXPORTER_OTLP_HEADERS, ...) mean what OpenTelemetry says.
_ENDPOINTS = ("OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT")
_PROTOCOLS = ("OTEL_EXPORTER_OTLP_TRACES_PROTOCOL", "OTEL_EXPORTER_OTLP_PROTOCOL")
_PROTOCOL = "http/protobuf"
REQUEST_ID_ATTRIBUTE = "ultragray.request_id"
_NS_PER_MS = 1_000_000


class Tracing:
    def __init__(self, component: str) -> None:
        for name in _PROTOCOLS:
            if os.environ.get(name, _PROTOCOL) != _PROTOCOL:
                raise InvalidArgument(f"{name} must be {_PROTOCOL}, got {os.environ[name]!r}", field=name)
        try:
            from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
            from opentelemetry.sdk.resources import Resource
            from opentelemetry.sdk.trace import TracerProvider
            from opentelemetry.sdk.trace.export import BatchSpanProcessor
        except ImportError as error:
            raise missing_extra(error, "OTEL_EXPORTER_OTLP_ENDPOINT") from None
        name = os.environ.get("OTEL_SERVICE_NAME", f"ultragray-{component}")
        self.provider = TracerProvider(resource=Resource.create({"service.name": name, "service.version": __version__}))
        self.provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter()))
        self._tracer = self.provider.get_tracer("ultragray", __version__)

    @contextmanager
    def call(self, name: str, carrier: Mapping[str, str]) -> Iterator[trace.Span]:
        """A span for a call of gRPC, within the trace that its metadata name; FastAPI makes those of HTTP."""
        with self._tracer.start_as_current_span(
            name,
            context=propagate.extract(carrier),
            kind=trace.SpanKind.SERVER,
            attributes={REQUEST_ID_ATTRIBUTE: request_id.get()},
        ) as span:
            yield span

    def observe_result(self, result: RenderResult[Any]) -> None:
        """Spans of a rendered request, made from the times that the pool measured: rendering pays nothing for them."""
        if not trace.get_current_span().is_recording():
            return
        attributes: dict[str, str | int] = {
            "ultragray.scene.gaussians": result.scene,
            "ultragray.scene_sha256": result.scene_sha256,
            "ultragray.renderer": result.renderer,
            "ultragray.poses": len(result.poses),
            "ultragray.batch_poses": result.batch_size,
        }
        stages = {"wait": result.queue_ms, "render": result.render_ms, "encode": result.encode_ms}
        start_ns = time.time_ns() - int(sum(stages.values()) * _NS_PER_MS)
        for stage, milliseconds in stages.items():
            end_ns = start_ns + int(milliseconds * _NS_PER_MS)
            self._tracer.start_span(f"pool {stage}", attributes=attributes, start_time=start_ns).end(end_ns)
            start_ns = end_ns

    def stop(self) -> None:
        self.provider.shutdown()


def start_tracing(component: str) -> Tracing | None:
    return Tracing(component) if any(os.environ.get(name) for name in _ENDPOINTS) else None
