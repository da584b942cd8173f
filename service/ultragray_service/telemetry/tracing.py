"""Traces of OpenTelemetry: a span for each request, and below it those of the render pool.

`OTEL_EXPORTER_OTLP_ENDPOINT` turns them on; the other standard variables (OTEL_SERVICE_NAME, OTEL_TRACES_SAMPLER,
OTEL_EXPORTER_OTLP_HEADERS, ...) mean what OpenTelemetry says.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from opentelemetry import propagate, trace

from ultragray import __version__
from ultragray.errors import InvalidArgument
from ultragray.installation import missing_extra
from ultragray_service.telemetry.logs import request_id
from ultragray_workers.pool.types import RenderResult

_ENDPOINTS = ("OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT")
_PROTOCOLS = ("OTEL_EXPORTER_OTLP_TRACES_PROTOCOL", "OTEL_EXPORTER_OTLP_PROTOCOL")
_PROTOCOL = "http/protobuf"
REQUEST_ID_ATTRIBUTE = "ultragray.request_id"
_NS_PER_MS = 1_000_000


class Tracing:
    """The tracing of one process, on until `stop`."""

    def __init__(self, component: str) -> None:
        """`component` is the service or the worker. Raises ExtraMissing, InvalidArgument for another protocol."""
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
        """A span for a call of gRPC, a part of the trace that the `traceparent` of its metadata names.

        FastAPI makes those of HTTP, with our `provider`.
        """
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
            "ultragray.scene": result.scene,
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
        """Sends what has not been sent."""
        self.provider.shutdown()


def start_tracing(component: str) -> Tracing | None:
    """The tracing of this process; None where no endpoint is set. Raises what `Tracing` raises."""
    return Tracing(component) if any(os.environ.get(name) for name in _ENDPOINTS) else None
