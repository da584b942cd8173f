"""Traces, as a collector of OpenTelemetry receives them from a service that runs."""

import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import grpc
import httpx
import pytest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest
from opentelemetry.proto.trace.v1.trace_pb2 import Status

from ultragray.errors import InvalidArgument
from ultragray_proto.v1 import rendering_pb2, rendering_pb2_grpc
from ultragray_service.telemetry.logs import start_tracing

from ...waiting import wait_until
from ..conftest import RunningService

pytestmark = pytest.mark.slow

TRACE = "4bf92f3577b34da6a3ce929d0e0e4736"
PARENT = "00f067aa0ba902b7"
CALLER = {"traceparent": f"00-{TRACE}-{PARENT}-01"}
STAGES = {"pool wait", "pool render", "pool encode"}


class Collector(ThreadingHTTPServer):
    """Takes spans at /v1/traces."""

    def __init__(self):
        self.spans = []
        super().__init__(("127.0.0.1", 0), _Handler)

    @property
    def url(self):
        return f"http://127.0.0.1:{self.server_port}"

    def whole_trace(self, count):
        """The spans of the caller's trace by name, once so many are there."""
        found = {span.name: span for span in self.spans if span.trace_id.hex() == TRACE}
        return found if len(found) == count else None


class _Handler(BaseHTTPRequestHandler):
    server: Collector

    def do_POST(self):
        body = ExportTraceServiceRequest.FromString(self.rfile.read(int(self.headers["Content-Length"])))
        for of_resource in body.resource_spans:
            for of_scope in of_resource.scope_spans:
                self.server.spans.extend(of_scope.spans)
        self.send_response(200)
        self.send_header("Content-Type", "application/x-protobuf")
        self.end_headers()

    def log_message(self, format, *arguments):
        """Keeps the output of the tests clean."""


@pytest.fixture
def collector():
    with Collector() as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


@pytest.fixture
def traced(collector, data_folder, tmp_path):
    environment = {"OTEL_EXPORTER_OTLP_ENDPOINT": collector.url, "OTEL_BSP_SCHEDULE_DELAY": "50"}
    with RunningService(data_folder, tmp_path / "log", environment) as service:
        service.wait_until_serving()
        yield service


def test_request_of_http_is_a_span_with_the_stages_of_the_pool_below(traced, collector, pose_body):
    url = f"{traced.http}/v1/scenes/demo/render"
    answer = httpx.post(url, json={"pose": pose_body}, headers={**CALLER, "X-Request-Id": "scan-7"}, timeout=300)
    assert answer.status_code == 200, answer.text
    found = wait_until(lambda: collector.whole_trace(len(STAGES) + 1))
    door = found["POST /v1/scenes/{scene}/render"]
    assert door.parent_span_id.hex() == PARENT
    assert {item.key: item.value.string_value for item in door.attributes}["ultragray.request_id"] == "scan-7"
    assert {name for name, span in found.items() if span.parent_span_id == door.span_id} == STAGES
    assert all(span.start_time_unix_nano <= span.end_time_unix_nano for span in found.values())
    assert [record["trace_id"] for record in traced.log() if record.get("request_id") == "scan-7"] == [TRACE]


def test_refused_request_is_a_span_that_failed(traced, collector):
    request = rendering_pb2.RenderRequest(settings=rendering_pb2.RenderSettings(scene="nowhere"))
    with traced.channel() as channel, pytest.raises(grpc.RpcError):
        rendering_pb2_grpc.RenderServiceStub(channel).Render(request, metadata=tuple(CALLER.items()), timeout=300)
    found = wait_until(lambda: collector.whole_trace(1))
    assert found["ultragray.v1.RenderService/Render"].status.code == Status.STATUS_CODE_ERROR


def test_job_is_a_span_of_its_worker_in_the_trace_of_its_submission(collector, data_folder, tmp_path):
    environment = {
        "OTEL_EXPORTER_OTLP_ENDPOINT": collector.url,
        "OTEL_BSP_SCHEDULE_DELAY": "50",
        "ULTRAGRAY_EMBEDDED_WORKER": "true",
        "ULTRAGRAY_ARTIFACT_FOLDER": str(tmp_path / "artifacts"),
    }
    job = {"kind": "render", "specification": {"scene": "demo", "sampler": {"kind": "training"}}}
    with RunningService(data_folder, tmp_path / "log", environment) as service:
        service.wait_until_serving()
        answer = httpx.post(f"{service.http}/v1/jobs", json=job, headers=CALLER, timeout=300)
        assert answer.status_code == 201, answer.text
        found = wait_until(lambda: collector.whole_trace(2), within_s=120)
    span = found["job render"]
    assert span.parent_span_id == found["POST /v1/jobs"].span_id
    assert {item.key: item.value.string_value for item in span.attributes}["ultragray.job"] == answer.json()["id"]
    assert span.status.code != Status.STATUS_CODE_ERROR


def test_health_is_not_traced_nor_a_service_without_an_endpoint(traced, collector, service, pose_body):
    for running in (traced, service):
        assert httpx.get(f"{running.http}/v1/health/ready", headers=CALLER, timeout=300).status_code == 200
    httpx.post(f"{service.http}/v1/scenes/demo/render", json={"pose": pose_body}, headers=CALLER, timeout=300)
    traced.terminate()  # sends what has not been sent
    assert collector.spans == []


@pytest.mark.parametrize("name", ["OTEL_EXPORTER_OTLP_PROTOCOL", "OTEL_EXPORTER_OTLP_TRACES_PROTOCOL"])
def test_another_protocol_is_refused_in_words(monkeypatch, name):
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", "http://127.0.0.1:4317")
    monkeypatch.setenv(name, "grpc")
    with pytest.raises(InvalidArgument, match=f"{name} must be http/protobuf, got 'grpc'"):
        start_tracing("service")
