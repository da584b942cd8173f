import os
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import grpc
import httpx
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

from ultragray_proto.v1 import rendering_pb2, rendering_pb2_grpc

from ..waiting import at_this_load, wait_until
from ..warm import Hold
from .conftest import ROOT, SOURCE_FOLDERS
from .rpc.test_grpc_render import Conversation, error_info, moved
from .test_clients_that_misbehave import LARGE, until_calm

IDENTITY = {"position_mm": {"x": 0, "y": 0, "z": 0}, "quaternion": {"w": 1, "x": 0, "y": 0, "z": 0}}
SMALL = {"height": 48, "width": 48}
WAITING = "ultragray_waiting_frames "
DELAY_S = 0.5
SLOW = {"backend": "reference", "max_batch_poses": 1}  # so that frames still wait when a test looks


@pytest.fixture(scope="module")
def slow(start_service):
    return start_service(**SLOW)


def render(service, client, **body):
    return client.post(f"{service.http}/v1/scenes/demo/render", json={"pose": IDENTITY, **body}, timeout=300)


def test_sigterm_answers_what_is_in_flight_and_exits_cleanly(start_service):
    service = start_service(**SLOW, drain_timeout_s=600, drain_delay_s=DELAY_S)
    frames = rendering_pb2.RenderSettings(scene="demo", **SMALL)
    with service.channel() as channel, httpx.Client(timeout=300) as client, ThreadPoolExecutor(8) as threads:
        stub = rendering_pb2_grpc.RenderServiceStub(channel)
        conversation = Conversation(stub)
        conversation.send(settings=frames)
        for sequence in range(4):
            conversation.send(sequence, pose=moved(0))
        with service.without_rendering():
            pending = [threads.submit(render, service, client, **SMALL) for _ in range(4)]
            request = rendering_pb2.RenderRequest(settings=frames, pose=moved(0))
            unary = stub.Render.future(request, timeout=300)
            numbers = ("ultragray_frames_total", WAITING, "ultragray_busy_processes ")  # one frame at a time
            wait_until(lambda: service.metric(*numbers) >= 9)  # all have come
            service.process.send_signal(signal.SIGTERM)
            wait_until(lambda: service.logged("stopping: frames"))
        assert [answer.result().status_code for answer in pending] == [200] * 4
        assert unary.result().data
        assert [next(conversation.call).sequence for _ in range(4)] == [0, 1, 2, 3]
        with pytest.raises(grpc.RpcError) as caught:
            next(conversation.call)
        assert caught.value.code() is grpc.StatusCode.UNAVAILABLE
        assert error_info(caught.value)[0].reason == "DRAINING"
        assert service.process.wait(300) == 0
        with pytest.raises(httpx.ConnectError):
            client.get(f"{service.http}/v1/health/live")


def test_sigint_stops_an_idle_service_at_once(start_service):
    service = start_service()
    with httpx.Client(timeout=300) as idle, service.channel() as channel:
        idle.get(f"{service.http}/v1/health/live")
        grpc.channel_ready_future(channel).result(60)
        began = time.monotonic()
        service.process.send_signal(signal.SIGINT)
        assert service.process.wait(300) == 0
    assert time.monotonic() - began < at_this_load(5)
    assert service.log()[-1]["message"] == "stopped"


def test_a_second_signal_stops_at_once(start_service):
    service = start_service(drain_timeout_s=3600)
    with httpx.Client(timeout=300) as client, ThreadPoolExecutor(4) as threads, service.without_rendering():
        pending = [threads.submit(render, service, client) for _ in range(4)]
        wait_until(lambda: service.metric(WAITING))
        service.process.send_signal(signal.SIGTERM)
        wait_until(lambda: service.logged("stopping: frames"))
        service.process.send_signal(signal.SIGTERM)
        assert service.process.wait(300) == 0
        for answer in pending:
            error = answer.exception()
            assert isinstance(error, httpx.TransportError) if error else answer.result().status_code == 503


def test_a_client_that_has_stopped_reading_keeps_no_service_from_stopping(start_service):
    service = start_service(drain_timeout_s=3600)
    options = [("grpc.http2.bdp_probe", 0), ("grpc.max_receive_message_length", -1)]  # so that its window stays small
    with grpc.insecure_channel(service.grpc, options=options) as channel:
        conversation = Conversation(rendering_pb2_grpc.RenderServiceStub(channel))
        conversation.send(settings=LARGE)
        for sequence in range(100):
            conversation.send(sequence, pose=moved(0))
        until_calm(service)  # frames are ready, and nobody takes them
        service.process.send_signal(signal.SIGTERM)
        assert service.process.wait(300) == 0
    assert service.log()[-1]["message"] == "stopped"


def test_a_service_that_leaves_is_not_ready_and_answers_until_its_delay_or_a_second_signal_ends_that(start_service):
    service = start_service(drain_delay_s=3600)
    with service.channel() as channel, httpx.Client(timeout=300) as client:
        conversation = Conversation(rendering_pb2_grpc.RenderServiceStub(channel))
        conversation.send(settings=rendering_pb2.RenderSettings(scene="demo", **SMALL))
        health = health_pb2_grpc.HealthStub(channel)
        wait_until(
            lambda: health.Check(health_pb2.HealthCheckRequest()).status == health_pb2.HealthCheckResponse.SERVING
        )
        service.process.send_signal(signal.SIGTERM)
        readiness = wait_until(lambda: not_ready(service, client))
        assert (readiness["reason"], readiness["components"]["frames"]["ready"]) == ("DRAINING", False)
        wait_until(
            lambda: health.Check(health_pb2.HealthCheckRequest()).status == health_pb2.HealthCheckResponse.NOT_SERVING
        )
        assert render(service, client, **SMALL).status_code == 200  # a new request
        conversation.send(7, pose=moved(0))
        assert next(conversation.call).sequence == 7
        service.process.send_signal(signal.SIGTERM)
        with pytest.raises(grpc.RpcError) as caught:
            next(conversation.call)
        assert error_info(caught.value)[0].reason == "DRAINING"
        assert service.process.wait(300) == 0


def not_ready(service, client):
    """The problem that readiness tells; None: the service is ready."""
    answer = client.get(f"{service.http}/v1/health/ready")
    return answer.json() if answer.status_code == 503 else None


def test_sigterm_while_starting(start_service):
    with Hold("start"):
        service = start_service(wait=False)
        wait_until(lambda: service.logged("starting to serve"))
        assert service.terminate() == 0
    assert not any("grpc" in record for record in service.log())


def test_a_full_queue_is_told_with_a_time_to_retry(start_service):
    service = start_service(**SLOW, queue_limit_frames=2)
    settings = rendering_pb2.RenderSettings(scene="demo", **SMALL)
    with httpx.Client(timeout=300) as client, ThreadPoolExecutor(3) as threads, service.channel() as channel:
        stub = rendering_pb2_grpc.RenderServiceStub(channel)
        with service.without_rendering():
            pending = []
            for waiting in range(3):  # the first is in hand
                pending.append(threads.submit(render, service, client, **SMALL))
                wait_until(lambda: service.metric(WAITING, "ultragray_busy_processes ") == len(pending))
                assert service.metric(WAITING) == waiting
            refused = render(service, client, **SMALL)
            assert (refused.status_code, refused.json()["reason"]) == (429, "QUEUE_FULL")
            assert int(refused.headers["retry-after"]) >= 1
            frame = Conversation(stub).ask(5, settings=settings, pose=moved(0))
            assert frame.error.reason == "QUEUE_FULL"
            batch = rendering_pb2.RenderBatchRequest(settings=settings, poses=[moved(0)] * 4)
            frames = stub.RenderBatch(batch, timeout=300)
        assert len(list(frames)) == 4  # a batch waits for room by itself
        assert [answer.result().status_code for answer in pending] == [200] * 3


def test_frames_of_a_client_that_has_gone_are_dropped(slow):
    with httpx.Client(timeout=300) as client:
        host, port = slow.http.removeprefix("http://").split(":")
        body = (
            b'{"height": 48, "width": 48, "poses": ['
            + b", ".join(
                [b'{"position_mm": {"x": 0, "y": 0, "z": 0}, "quaternion": {"w": 1, "x": 0, "y": 0, "z": 0}}'] * 100
            )
            + b"]}"
        )
        head = (
            f"POST /v1/scenes/demo/render HTTP/1.1\r\nHost: {host}\r\nContent-Type: application/json\r\n"
            f"Content-Length: {len(body)}\r\n\r\n"
        )
        with slow.without_rendering():
            with socket.create_connection((host, int(port))) as connection:
                connection.sendall(head.encode() + body)
                wait_until(lambda: slow.metric(WAITING))
            wait_until(lambda: slow.metric(WAITING) == 0)
        assert render(slow, client).status_code == 200


def test_interactive_frames_go_before_a_batch(slow):
    with slow.channel() as channel, httpx.Client(timeout=300) as client:
        stub = rendering_pb2_grpc.RenderServiceStub(channel)
        settings = rendering_pb2.RenderSettings(scene="demo", **SMALL)
        batch = rendering_pb2.RenderBatchRequest(settings=settings, poses=[moved(0)] * 12)
        received, lines_before = [], len(slow.log())

        def ended():
            """Requests and calls, by the last word of their name, in the order in which they ended."""
            names = (record.get("path") or record.get("method", "") for record in slow.log()[lines_before:])
            return [name.rpartition("/")[2] for name in names]

        reader = threading.Thread(target=lambda: received.extend(f.sequence for f in stub.RenderBatch(batch)))
        with ThreadPoolExecutor(1) as threads, slow.without_rendering():
            reader.start()
            waiting = wait_until(lambda: slow.metric(WAITING))
            answer = threads.submit(render, slow, client, **SMALL)
            wait_until(lambda: slow.metric(WAITING) > waiting)
        assert answer.result().status_code == 200
        reader.join()
        assert received == list(range(12))
        wait_until(lambda: "RenderBatch" in ended())
        assert ended().index("render") < ended().index("RenderBatch")


def test_a_port_in_use_is_one_clear_error(start_service, service):
    http_port, grpc_port = service.http.rsplit(":", 1)[1], service.grpc.rsplit(":", 1)[1]
    for settings, name in (({"http_port": http_port}, "HTTP"), ({"grpc_port": grpc_port}, "gRPC")):
        second = start_service(wait=False, **settings)
        assert second.process.wait(300) == 1
        said = second.log_path.read_text().splitlines()
        assert f"{name} cannot listen on 127.0.0.1:" in said[-1]
        assert "Traceback" not in second.log_path.read_text()


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"data_folder": "/nonexistent"}, "data_folder must be an existing folder"),
        ({"preload": "demo,nowhere"}, "'nowhere' cannot be preloaded"),
        ({"processes": "none"}, "ULTRAGRAY_PROCESSES"),
    ],
)
def test_bad_settings_are_one_clear_error(start_service, settings, expected):
    service = start_service(wait=False, **settings)
    assert service.process.wait(300) == 1
    said = service.log_path.read_text()
    assert expected in said.splitlines()[-1]
    assert "Traceback" not in said


@pytest.mark.slow
def test_neither_service_nor_worker_nor_intake_import_torch():
    code = (
        "import sys, ultragray_service.server, ultragray_workers.datasets.intake, "
        "ultragray_workers.jobs.worker.worker; from ultragray_workers.jobs.kinds import CompareJob; "
        "CompareJob(dataset='tiny', methods=('median',)); sys.exit('torch' in sys.modules)"
    )
    path = os.pathsep.join(str(ROOT / folder) for folder in SOURCE_FOLDERS)
    subprocess.run([sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": path}, check=True)
