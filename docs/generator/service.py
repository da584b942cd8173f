"""Parts about the service: settings, errors, metrics."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime, timezone

import numpy as np
from prometheus_client.metrics_core import Metric

from ultragray import LinearProbe, errors
from ultragray.contract import annotated_fields, range_of
from ultragray.rendering.settings import Resolved
from ultragray_client import errors as client_errors
from ultragray_service import errors as service_errors
from ultragray_service.errors import statuses_of
from ultragray_service.service import Service
from ultragray_service.settings import ENVIRONMENT_PREFIX, Settings
from ultragray_workers import errors as workers_errors
from ultragray_workers.errors import QueueFull
from ultragray_workers.jobs.demand import AUTO
from ultragray_workers.jobs.record import JobState
from ultragray_workers.jobs.store import JobsOverview
from ultragray_workers.jobs.workers import WorkerState
from ultragray_workers.pool.messages import RenderResult

from .http_api import temporary_service
from .markdown import code, codes, in_line, summary, table


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
