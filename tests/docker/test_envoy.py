"""The configuration of Envoy with a real Envoy, before replicas that tell who they are and what they were asked."""

import subprocess
import sys
import threading
from concurrent import futures
from contextlib import ExitStack
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import grpc
import httpx
import pytest
import yaml
from grpc_health.v1 import health, health_pb2, health_pb2_grpc

from .envoy import FOLDER, Envoy, program, script

pytestmark = pytest.mark.slow

READY = "/v1/health/ready"


SCENES = [f"scene{number}" for number in range(24)]


class Stub(grpc.GenericRpcHandler):
    """A replica of which only the doors are real: it answers with its name, or breaks connections."""

    def __init__(self, name):
        self.name = name
        self.asked = []  # methods and paths, without those of health checks
        self.breaks = False
        self._health = health.HealthServicer()
        self._http = ThreadingHTTPServer(("127.0.0.1", 0), self._handler())
        threading.Thread(target=self._http.serve_forever, daemon=True).start()
        self._grpc = grpc.server(futures.ThreadPoolExecutor(8), handlers=[self])
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self._grpc)
        self.grpc_port = self._grpc.add_insecure_port("127.0.0.1:0")
        self.http_port = self._http.server_address[1]
        self._grpc.start()
        self.set_ready(True)

    def set_ready(self, ready):
        self.ready = ready
        code = health_pb2.HealthCheckResponse
        self._health.set("", code.SERVING if ready else code.NOT_SERVING)

    def close(self):
        self._http.shutdown()
        self._http.server_close()
        self._grpc.stop(None).wait()

    def service(self, details):
        """The handler of a call of gRPC."""
        if details.method.startswith("/grpc.health"):
            return None

        def answer(request, context):
            self.asked.append(details.method)
            if self.breaks:
                context.abort(grpc.StatusCode.UNAVAILABLE, "stopping")
            return self.name.encode()

        return grpc.unary_unary_rpc_method_handler(answer)

    def _handler(self):
        stub = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self):
                status = 200
                self.rfile.read(int(self.headers.get("content-length", 0)))
                if self.path == READY:
                    is_known = self.headers["host"] == "localhost"  # a service without keys refuses other names
                    status = 200 if stub.ready and is_known else 503
                else:
                    stub.asked.append(f"{self.command} {self.path}")
                    if stub.breaks:
                        self.close_connection = True
                        return  # without an answer
                body = stub.name.encode()
                self.send_response(status)
                self.send_header("content-length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def do_POST(self):
                self.do_GET()

            def log_message(self, *_):
                """Nothing."""

        return Handler


@pytest.fixture
def start(tmp_path):
    with ExitStack() as started:

        def start(count=3, **hot_scenes):
            program()
            stubs = [Stub(f"replica{number}") for number in range(count)]
            for stub in stubs:
                started.callback(stub.close)
            replicas = [script().Replica("127.0.0.1", stub.http_port, stub.grpc_port) for stub in stubs]
            envoy = started.enter_context(Envoy(tmp_path, replicas, hot_scenes))
            envoy.wait_for()
            return envoy, stubs

        yield start


def over_http(envoy, path, method="GET"):
    return httpx.request(method, envoy.http + path, timeout=300).raise_for_status().text


def over_grpc(envoy, method, scene=None):
    metadata = () if scene is None else (("x-ultragray-scene", scene),)
    with grpc.insecure_channel(envoy.grpc) as channel:
        answer = channel.unary_unary(f"/ultragray.v1.{method}")(b"", metadata=metadata, timeout=300)
    return answer.decode()


def test_a_scene_has_one_home_at_all_doors(start):
    envoy, _ = start()
    homes = {scene: over_http(envoy, f"/v1/scenes/{scene}/render", "POST") for scene in SCENES}
    assert len(set(homes.values())) > 1
    for scene, home in homes.items():
        for path in (f"/v1/scenes/{scene}", f"/v1/scenes/{scene}?a=b", f"/v1/scenes/{scene}/file"):
            assert over_http(envoy, path) == home
        assert over_http(envoy, f"/v1/scenes/{scene}:load", "POST") == home
        assert over_grpc(envoy, "RenderService/Render", scene) == home


def test_what_is_about_no_scene_goes_anywhere(start):
    envoy, _ = start()
    assert len({over_http(envoy, "/v1/scenes") for _ in range(60)}) == 3
    assert len({over_grpc(envoy, "JobService/ListJobs") for _ in range(60)}) == 3


def test_a_hot_scene_has_several_homes(start):
    envoy, _ = start(hot=8)
    assert len({over_http(envoy, "/v1/scenes/hot/render", "POST") for _ in range(60)}) > 1
    assert len({over_grpc(envoy, "RenderService/Render", "hot") for _ in range(60)}) > 1
    assert len({over_http(envoy, "/v1/scenes/cold/render", "POST") for _ in range(20)}) == 1


def test_nothing_new_goes_to_a_replica_that_is_not_ready(start):
    envoy, stubs = start()
    stubs[0].set_ready(False)
    envoy.wait_for(healthy=2)
    stubs[0].asked.clear()
    for scene in SCENES:
        over_http(envoy, f"/v1/scenes/{scene}/render", "POST")
        over_grpc(envoy, "RenderService/Render", scene)
        over_http(envoy, "/v1/jobs", "POST")
    assert stubs[0].asked == []
    for stub in stubs:
        stub.set_ready(False)
    envoy.wait_for(healthy=0)
    assert over_http(envoy, "/v1/scenes/demo") in {
        stub.name for stub in stubs
    }  # each says why, or answers all the same


def test_a_replica_that_is_gone_is_not_noticed(start):
    envoy, stubs = start()
    stubs[0].close()
    for scene in SCENES:
        assert over_http(envoy, f"/v1/scenes/{scene}/render", "POST") != stubs[0].name
        assert over_grpc(envoy, "RenderService/Render", scene) != stubs[0].name
        assert over_http(envoy, "/v1/jobs", "POST") != stubs[0].name
        assert over_grpc(envoy, "JobService/SubmitJob") != stubs[0].name


def test_what_changes_something_is_never_sent_twice(start):
    envoy, stubs = start()
    for stub in stubs:
        stub.breaks = True
    for method, path in (("POST", "/v1/jobs"), ("POST", "/v1/scenes/demo:load"), ("POST", "/v1/jobs/7:cancel")):
        assert httpx.request(method, envoy.http + path, timeout=300).status_code == 503
        assert sum(stub.asked.count(f"{method} {path}") for stub in stubs) == 1
    with pytest.raises(grpc.RpcError):
        over_grpc(envoy, "JobService/SubmitJob")
    assert sum(stub.asked.count("/ultragray.v1.JobService/SubmitJob") for stub in stubs) == 1


@pytest.mark.parametrize("path", ["/v1/scenes/demo", "/v1/jobs", "/v1/scenes/demo/render"])
def test_what_changes_nothing_is_asked_of_another(start, path):
    envoy, stubs = start()
    method = "POST" if path.endswith("render") else "GET"
    for stub in stubs[:-1]:
        stub.breaks = True
    for _ in range(8):
        assert over_http(envoy, path, method) == stubs[-1].name


def test_the_file_is_valid_as_it_stands(tmp_path):
    subprocess.run([program(), "--mode", "validate", "-c", FOLDER / "envoy.yaml"], check=True, capture_output=True)
    made = subprocess.run(
        [sys.executable, FOLDER / "configure.py", "--replica", "a:1:2", "--replica", "b:3:4", "--hot", 'sp"ine=2'],
        check=True,
        capture_output=True,
    ).stdout
    assert {cluster["name"] for cluster in yaml.safe_load(made)["static_resources"]["clusters"]}
    (tmp_path / "envoy.yaml").write_bytes(made)
    command = [program(), "--mode", "validate", "-c", tmp_path / "envoy.yaml"]
    subprocess.run(command, check=True, capture_output=True)
