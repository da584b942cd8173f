"""The span of a job in the traces of OpenTelemetry: a part of the trace of the request that submitted it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from dbos import WorkflowStatus
from opentelemetry import propagate, trace

from ultragray_workers.jobs.job import attribute

TRACE = "trace"  # the attribute of a job that names it


def current_trace() -> dict[str, str]:
    """The trace of the running code, to be kept with a job; empty where it is not traced."""
    carrier: dict[str, str] = {}
    propagate.inject(carrier)
    return carrier


@contextmanager
def job_span(row: WorkflowStatus, worker: str) -> Iterator[trace.Span]:
    """A span for one attempt at a job; a worker that is not traced sends it nowhere."""
    attributes: dict[str, str | int] = {
        "ultragray.job": row.workflow_id,
        "ultragray.worker": worker,
        "ultragray.attempt": row.recovery_attempts or 1,
    }
    with trace.get_tracer("ultragray").start_as_current_span(
        f"job {row.name}",
        context=propagate.extract(attribute(row, TRACE) or {}),
        kind=trace.SpanKind.CONSUMER,
        attributes=attributes,
    ) as span:
        yield span
