"""HTTP: requests made from the OpenAPI document, bodies and paths nearly right, bytes that are no requests."""

import contextlib
import http.client
import json
import re
import socket
from urllib.parse import quote

import pytest
import requests
import schemathesis
from hypothesis import strategies as st
from schemathesis.checks import load_all_checks
from schemathesis.core.failures import FailureGroup
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from ..model.datasets.conftest import make_sweep
from ..waiting import at_this_load
from .fuzzed import EXPECTED_5XX
from .mutations import TEXTS, as_json, mutated_bytes, mutated_json
from .test_fuzz_websocket import MATRIX, POSE, SETTINGS

__all__ = ["make_sweep"]

pytestmark = pytest.mark.long

TIMEOUT_S = 60.0
LEFT_OUT = ("/events", ":simulate")  # of a job that waits; half a minute of simulation, of any name that can be
RENDER = "/v1/scenes/demo/render"
BODIES = (
    (RENDER, {"pose": POSE, **SETTINGS, "timeout_ms": 5000.0}),
    (
        RENDER,
        {"poses": [POSE, MATRIX], "height": 16, "width": 12, "outputs": ["bmode", "coverage"], "dtype": "float32"},
    ),
    ("/v1/probes:plane", {"probe": {"kind": "convex", "opening_angle_deg": 60.0, "near_mm": 10.0, "far_mm": 60.0}}),
    ("/v1/probes:plane", {"probe": {"kind": "radial", "near_mm": 1.0, "far_mm": 60.0}, "width": 16, "height": 16}),
    ("/v1/jobs", {"kind": "train", "dataset": "absent", "scene": "new", "settings": {"steps": 10}, "request_id": "a"}),
    ("/v1/jobs", {"kind": "compare", "dataset": "absent", "methods": ["median", "linear"], "times": 2.0, "seed": 1}),
    ("/v1/jobs", {"kind": "evaluate", "dataset": "absent", "scene": "demo", "priority": 3}),
    (
        "/v1/jobs",
        {"kind": "render", "scene": "demo", "sampler": {"kind": "around", "count": 2}, "height": 16, "width": 12},
    ),
)
TYPES = (
    "application/json",
    "image/png",
    "application/octet-stream",
    "application/x-npz",
    "application/*;q=0.1",
    "*/*",
    "x",
)


CHECKS = [status_code_conformance, content_type_conformance, response_headers_conformance, response_schema_conformance]


def unreadable(operation):
    """The checks that Schemathesis cannot make: it takes `prefixItems` of OpenAPI 3.1 for `items` (in 4.32)."""
    return [response_schema_conformance] if operation.path == "/v1/probes:plane" else []


def is_expected(status):
    return status < 500 or status in EXPECTED_5XX


class Connection:
    """One that is kept alive, opened again where the service has closed it."""

    def __init__(self, fuzzed):
        self._fuzzed = fuzzed
        self._opened = None

    def ask(self, method, path, body, headers):
        """Status and body; asked again over a new connection where the old one was closed meanwhile."""
        self._fuzzed.require_alive()
        for is_last in (False, True):
            if self._opened is None:
                self._opened = http.client.HTTPConnection(*self._fuzzed.address, timeout=at_this_load(TIMEOUT_S))
            try:
                self._opened.request(method, path, body, headers)
                with self._opened.getresponse() as answer:
                    return answer.status, answer.read()
            except (ConnectionError, http.client.BadStatusLine):
                self.close()
                if is_last:
                    raise
        raise AssertionError("unreachable")

    def close(self):
        if self._opened is not None:
            self._opened.close()
            self._opened = None


@pytest.fixture
def connection(well):
    opened = Connection(well)
    yield opened
    opened.close()


def test_what_the_document_allows_and_what_it_does_not(door, well):
    load_all_checks()
    schema = schemathesis.openapi.from_url(f"{well.running.http}/openapi.json")
    operations = [found.ok() for found in schema.get_all_operations()]
    operations = [operation for operation in operations if not operation.path.endswith(LEFT_OUT)]
    with requests.Session() as session:

        def attempt(case):
            well.require_alive()
            answer = case.call(base_url=well.running.http, session=session, timeout=TIMEOUT_S)
            assert is_expected(answer.status_code), (
                f"{case.as_curl_command()}: {answer.status_code} {answer.text[:500]}"
            )
            try:
                case.validate_response(answer, checks=CHECKS, excluded_checks=unreadable(case.operation))
            except FailureGroup as failures:
                raise AssertionError("; ".join(str(one) for one in failures.exceptions)) from None

        inputs = []
        for operation in operations:
            inputs += [operation.as_strategy(generation_mode=mode) for mode in schemathesis.GenerationMode]
            if "{scene}" in operation.path and operation.method in ("get", "post"):
                inputs.append(operation.as_strategy(path_parameters={"scene": "demo"}))
        door("http documented").enter(st.one_of(inputs), attempt)


def test_bodies(door, connection):
    by_path = {path: [body for at, body in BODIES if at == path] for path, _ in BODIES}
    raw = {path: mutated_bytes([json.dumps(body).encode() for body in bodies]) for path, bodies in by_path.items()}

    def of(path):
        body = st.one_of(mutated_json(by_path[path]).map(as_json), mutated_json(by_path[path]).map(as_json), raw[path])
        return st.tuples(st.just(path), body, st.sampled_from(TYPES))

    def attempt(asked):
        path, body, accepted = asked
        headers = {"Content-Type": "application/json", "Accept": accepted}
        status, answer = connection.ask("POST", path, body, headers)
        assert is_expected(status), (status, answer[:500])
        if status >= 400:
            problem = json.loads(answer)
            assert problem["reason"]
            assert problem["status"] == status

    door("http bodies").enter(st.sampled_from(sorted(by_path)).flatmap(of), attempt)


OTHER_PATHS = ("/metrics", "/openapi.json", "/docs", "/")
QUERIES = ("page_size", "page_token", "state", "kind", "max_points", "dataset", "step", "format", "x")


def test_paths_and_queries(door, connection):
    document = json.loads(connection.ask("GET", "/openapi.json", None, {})[1])
    names = {"scene": "demo", "index": "0", "part": "train", "what": "truth"}
    documented = [path for path in document["paths"] if not path.endswith(LEFT_OUT)]
    paths = [
        *(re.sub(r"{(\w+)}", lambda found: names.get(found[1], "absent"), path) for path in documented),
        *OTHER_PATHS,
    ]
    values = st.one_of(st.sampled_from(TEXTS), st.integers().map(str), st.text(max_size=12))
    parts = st.lists(st.tuples(st.integers(0, 8), values), max_size=1)
    query = st.lists(st.tuples(st.sampled_from(QUERIES), values), max_size=3)
    methods = st.sampled_from(["GET", "GET", "GET", "HEAD", "OPTIONS", "POST", "DELETE", "PATCH", "TRACE", "GETX"])
    headers = st.dictionaries(
        st.sampled_from(
            ["Range", "If-None-Match", "Accept", "Accept-Encoding", "Last-Event-ID", "X-Request-ID", "Origin"]
        ),
        st.one_of(values, st.sampled_from(["bytes=0-", "bytes=5-2", "bytes=-0", 'W/"x"', "*", "gzip;q=nan", "null"])),
        max_size=2,
    )

    def attempt(asked):
        method, path, changed, queried, told = asked
        pieces = path.split("/")
        for index, value in changed:
            pieces[index % len(pieces)] = quote(value, safe="", errors="surrogatepass")
        whole = "/" + "/".join(pieces).lstrip("/")
        whole += "?" + "&".join(f"{name}={quote(value, safe='', errors='surrogatepass')}" for name, value in queried)
        encoded = {name: quote(value, safe=' =-*"/;,', errors="surrogatepass") for name, value in told.items()}
        status, answer = connection.ask(method, whole, None, encoded)
        assert is_expected(status), (status, answer[:500])

    door("http paths").enter(st.tuples(methods, st.sampled_from(paths), parts, query, headers), attempt)


def test_bytes(door, well):
    body = json.dumps(BODIES[0][1]).encode()
    head = b"POST %s HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: %d\r\n\r\n"
    chunked = b"POST %s HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n%x\r\n%s\r\n0\r\n\r\n"
    upgrade = (
        b"GET /v1/scenes/demo/stream HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\n\r\n\x81\x82\0\0\0\0{}"
    )
    upload = (
        b"PUT /v1/datasets/new HTTP/1.1\r\nHost: localhost\r\nContent-Type: multipart/form-data; boundary=b\r\n"
        b'Content-Length: 82\r\n\r\n--b\r\nContent-Disposition: form-data; name="f"; filename="conf.json"\r\n\r\n'
        b"{}\r\n--b--\r\n"
    )
    whole = [
        b"GET /v1/scenes HTTP/1.1\r\nHost: localhost\r\nAccept: */*\r\n\r\n" * 2,
        head % (RENDER.encode(), len(body)) + body,
        chunked % (RENDER.encode(), len(body), body),
        upgrade,
        upload,
    ]

    def attempt(data):
        well.require_alive()
        with socket.create_connection(well.address, timeout=TIMEOUT_S) as peer, contextlib.suppress(ConnectionError):
            peer.sendall(data)
            peer.shutdown(socket.SHUT_WR)
            answer = b""
            while block := peer.recv(65536):
                answer += block
            if answer.startswith(b"HTTP/1.1 "):
                assert is_expected(int(answer[9:12])), answer[:1000]

    door("http bytes").enter(mutated_bytes(whole), attempt)
