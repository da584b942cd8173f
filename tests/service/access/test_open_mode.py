"""Without keys: this machine only, and no page of another site, whatever its DNS says."""

import asyncio
import socket

import grpc
import httpx
import pytest

from ultragray_proto.v1 import scenes_pb2, scenes_pb2_grpc
from ultragray_service.http.app import create_app
from ultragray_service.settings import load_settings
from ultragray_service.wiring import make_service

from ..rpc.test_grpc_render import error_info

ELSEWHERE = "http://elsewhere.example"
ROUTES = [
    ("GET", "/"),
    ("GET", "/docs"),
    ("GET", "/openapi.json"),
    ("GET", "/metrics"),
    ("GET", "/v1/health/live"),
    ("GET", "/v1/scenes"),
    ("GET", "/v1/scenes/demo/file"),
    ("POST", "/v1/scenes/demo:unload"),
    ("POST", "/v1/jobs"),
    ("DELETE", "/v1/datasets/liver"),
    ("PUT", "/v1/scenes/other"),
    ("OPTIONS", "/v1/scenes"),
]


@pytest.mark.parametrize(("method", "path"), ROUTES)
def test_pages_of_other_sites_reach_no_route(http, method, path):
    for origin in (ELSEWHERE, "null", "http://[", "http://localhost.elsewhere.example", "http://127.0.0.1:1"):
        answer = http.request(method, path, headers={"Origin": origin})
        assert (answer.status_code, answer.json()["reason"]) == (403, "ORIGIN_REFUSED"), origin
        assert "access-control-allow-origin" not in answer.headers


@pytest.mark.parametrize(("method", "path"), ROUTES)
def test_a_name_that_was_pointed_here_reaches_no_route(http, method, path):
    for host in (
        "elsewhere.example",
        "elsewhere.example:8000",
        "localhost.elsewhere.example",
        "10.0.0.7:8000",
        "[::",
        "localhost#.evil",
        "localhost/.evil",
        "localhost?.evil",
        "a@localhost",
        "localhost:80:80",
        "[::1].evil",
        "",
    ):
        headers = {"Host": host, "Origin": f"http://{host}"}
        answer = http.request(method, path, headers=headers)
        assert (answer.status_code, answer.json()["reason"]) == (403, "HOST_REFUSED"), host


def test_pictures_and_scripts_of_other_sites_are_refused_and_links_are_not(http):
    fetched = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors", "Sec-Fetch-Dest": "image"}
    assert http.get("/v1/scenes", headers=fetched).json()["reason"] == "ORIGIN_REFUSED"
    followed = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"}
    assert http.get("/", headers=followed).status_code == 200
    assert http.post("/v1/scenes/demo:unload", headers=followed).json()["reason"] == "ORIGIN_REFUSED"
    assert http.get("/docs", headers={**followed, "Sec-Fetch-Dest": "iframe"}).json()["reason"] == "ORIGIN_REFUSED"
    assert http.get("/v1/scenes", headers={"Sec-Fetch-Site": "same-origin"}).status_code == 200


@pytest.mark.parametrize("path", ["/", "/docs"])
def test_no_page_shows_ours_within_itself(http, path):
    headers = http.get(path).headers
    assert "frame-ancestors 'none'" in headers["content-security-policy"]
    assert headers["x-frame-options"] == "DENY"


def test_this_machine_is_let_in_under_each_of_its_names(http, service):
    port = service.http.rpartition(":")[2]
    for host in ("localhost", f"localhost:{port}", f"127.0.0.1:{port}", "127.8.9.1", f"[::1]:{port}", "LOCALHOST"):
        assert http.get("/v1/scenes", headers={"Host": host}).status_code == 200, host
        assert http.get("/v1/scenes", headers={"Host": host, "Origin": f"http://{host}"}).status_code == 200, host
    with socket.create_connection(("127.0.0.1", int(port))) as connection:  # of a client that knows no Host
        connection.sendall(b"GET /v1/health/live HTTP/1.0\r\n\r\n")
        assert b" 200 " in connection.recv(4096)


def test_a_page_behind_a_proxy_of_grpc_web_is_refused(service):
    with service.channel() as channel:
        stub = scenes_pb2_grpc.SceneServiceStub(channel)
        with pytest.raises(grpc.RpcError) as caught:
            stub.UnloadScene(scenes_pb2.UnloadSceneRequest(scene="demo"), metadata=(("origin", ELSEWHERE),))
    assert caught.value.code() is grpc.StatusCode.PERMISSION_DENIED
    assert error_info(caught.value)[0].reason == "ORIGIN_REFUSED"


@pytest.fixture
def status_of(tmp_path):
    """The answer of a service of its own, which is not started, to a request with headers."""

    def ask(path, headers, **settings):
        app = create_app(make_service(load_settings(data_folder=tmp_path, **settings)))

        async def answer():
            async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://127.0.0.1") as client:
                return (await client.get(path, headers=headers)).status_code

        return asyncio.run(answer())

    return ask


def test_names_and_origins_can_be_allowed(status_of):
    allowed = {"allowed_hosts": "simulator.lab", "cors_origins": "http://app.lab"}
    own = {"Host": "simulator.lab:8000", "Origin": "http://simulator.lab:8000"}
    for headers, status in ((own, 200), ({"Origin": "http://app.lab"}, 200), ({"Origin": ELSEWHERE}, 403)):
        assert status_of("/v1/health/live", headers, **allowed) == status, headers


def test_insecure_opens_a_public_address_to_addresses_but_not_to_names(status_of):
    for host, status in {"192.168.0.9:8000": 200, "[fe80::1]:8000": 200, "elsewhere.example": 403}.items():
        assert status_of("/v1/me", {"Host": host}, host="0.0.0.0", insecure=True) == status, host


def test_with_keys_any_name_will_do_and_pages_need_a_key(status_of):
    key, foreign = "0123456789abcdef", {"Host": "simulator.lab", "Origin": ELSEWHERE}
    assert status_of("/v1/me", foreign, host="0.0.0.0", api_keys=key) == 401
    assert status_of("/v1/me", {**foreign, "X-API-Key": key}, host="0.0.0.0", api_keys=key) == 200


def test_a_public_address_without_keys_is_refused(start_service, tmp_path):
    service = start_service(wait=False, artifact_folder=tmp_path, host="0.0.0.0")
    assert service.process.wait(300) != 0
    text = service.log_path.read_text()
    for words in ("0.0.0.0", "ultragray keys create", "ULTRAGRAY_API_KEYS", "ULTRAGRAY_INSECURE"):
        assert words in text
