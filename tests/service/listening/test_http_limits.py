"""One client, without a key or with one, cannot hold up the HTTP port: not by size, not by time, not by number."""

import contextlib
import json
import socket
import time
from urllib.parse import urlsplit

import httpx
import numpy as np
import pytest
from websockets.sync.client import connect

from ...waiting import wait_until

MEBIBYTE = 2**20
HEADER_BYTES = 64 * 1024
TOTAL, PER_ADDRESS = 40, 12
REQUEST = b"GET /v1/health/live HTTP/1.1\r\nHost: localhost\r\n"
CHUNKED = b"POST /v1/probes:plane HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n"
KEY = "a-key-of-these-tests"
TIMEOUT_S = 300.0


@pytest.fixture(scope="module")
def limited(start_service):
    """A service with limits of sizes and numbers."""
    return start_service(
        api_keys=KEY,
        header_timeout_s=600,
        idle_timeout_s=600,
        max_connections=TOTAL,
        max_connections_per_address=PER_ADDRESS,
        max_body_bytes=20 * MEBIBYTE,
    )


@pytest.fixture(scope="module")
def hasty(start_service):
    """A service whose patience a test reaches in moments."""
    return start_service(
        api_keys=KEY, header_timeout_s=1, idle_timeout_s=1, min_bytes_per_s=1000, transfer_patience_s=1
    )


@pytest.fixture(autouse=True)
def _others_are_answered(limited):
    """Whatever one address does, another is answered at once."""
    yield
    with open_socket(limited, "127.0.0.9") as other:
        other.sendall(REQUEST + b"\r\n")
        assert status_of(answer(other)) == 200


def open_socket(service, source="127.0.0.1", **options):
    parts = urlsplit(service.http)
    opened = socket.socket()
    for option, value in options.items():
        opened.setsockopt(socket.SOL_SOCKET, getattr(socket, option), value)
    opened.settimeout(TIMEOUT_S)
    opened.bind((source, 0))
    opened.connect((parts.hostname, parts.port))
    return opened


def answer(opened):
    """Head and body of one answer; empty where the server closed without one."""
    head = b""
    while not head.endswith(b"\r\n\r\n"):
        if not (byte := opened.recv(1)):  # what follows is another answer's
            return head
        head += byte
    length = next((int(line[15:]) for line in head.lower().split(b"\r\n") if line.startswith(b"content-length:")), 0)
    body = b""
    while len(body) < length:
        body += opened.recv(length - len(body))
    return head + body


def status_of(data):
    return int(data.split(b" ", 2)[1])


def problem_of(data):
    head, _, body = data.partition(b"\r\n\r\n")
    assert b"content-type: application/problem+json" in head.lower()
    assert b"connection: close" in head.lower()
    problem = json.loads(body)
    assert problem["status"] == status_of(data)
    assert problem["request_id"]
    return problem


def is_closed(opened):
    try:
        while opened.recv(65536):
            pass
    except ConnectionError:
        pass
    return True


def send_until_refused(opened, data):
    with contextlib.suppress(ConnectionError):
        opened.sendall(data)


@pytest.mark.parametrize(
    ("start", "filling", "status", "reason"),
    [
        (b"GET /", b"a", 414, "TARGET_TOO_LONG"),
        (REQUEST + b"X-Long: ", b"a", 431, "HEADERS_TOO_LARGE"),
        (REQUEST, b"a", 431, "HEADERS_TOO_LARGE"),
        (REQUEST, b"X-Many: 1\r\n", 431, "HEADERS_TOO_LARGE"),
        (b"", b"\r\n", 431, "HEADERS_TOO_LARGE"),
        (b"", b"A", 400, "REQUEST_MALFORMED"),
    ],
    ids=["request line", "header", "header name", "headers", "empty lines", "method"],
)
def test_a_head_without_end_is_refused_while_it_comes(limited, start, filling, status, reason):
    before = limited.resident_bytes()
    with open_socket(limited) as opened:
        opened.sendall(start)
        send_until_refused(opened, filling * (2 * HEADER_BYTES // len(filling)))
        problem = problem_of(answer(opened))
        assert (problem["status"], problem["reason"]) == (status, reason)
    with open_socket(limited) as opened:
        opened.sendall(start)
        send_until_refused(opened, filling * (40 * MEBIBYTE // len(filling)))
        assert is_closed(opened)
    assert limited.resident_bytes() - before < 30 * MEBIBYTE


def test_a_head_within_the_limits_is_answered(limited):
    with open_socket(limited) as opened:
        opened.sendall(REQUEST + b"X-Long: " + b"a" * 30_000 + b"\r\n" + b"X-Many: 1\r\n" * 100 + b"\r\n")
        assert status_of(answer(opened)) == 200


def test_more_headers_than_allowed_are_refused(limited):
    with open_socket(limited) as opened:
        opened.sendall(REQUEST + b"a:\r\n" * 1000 + b"\r\n")
        problem = problem_of(answer(opened))
        assert (problem["status"], problem["reason"]) == (431, "HEADERS_TOO_LARGE")
        assert is_closed(opened)


@pytest.mark.parametrize("trailers", [b"X-A: " + b"b" * 150_000 + b"\r\n", b"X-A: b\r\n" * 20_000])
def test_trailers_are_bounded_like_headers(limited, trailers):
    with open_socket(limited) as opened:
        opened.sendall(CHUNKED + f"X-API-Key: {KEY}\r\n\r\n0\r\n".encode() + trailers + b"\r\n")
        assert status_of(answer(opened)) == 431


def test_trailers_are_no_headers(limited):
    with open_socket(limited) as opened:
        opened.sendall(CHUNKED + f"\r\n0\r\nX-API-Key: {KEY}\r\n\r\n".encode())
        assert status_of(answer(opened)) == 401
        opened.sendall(REQUEST + b"\r\n")
        assert status_of(answer(opened)) == 200


def test_requests_piled_up_on_one_connection_are_refused(limited):
    with open_socket(limited) as opened:
        opened.sendall((REQUEST + b"\r\n") * 20)
        assert [status_of(answer(opened)) for _ in range(1)] == [200]
    before = limited.resident_bytes()
    with open_socket(limited) as opened:
        send_until_refused(opened, (REQUEST + b"\r\n") * 100_000)
        assert is_closed(opened)
    assert limited.resident_bytes() - before < 30 * MEBIBYTE


@pytest.mark.parametrize("sent", [b"", b"GET / HTTP/1.1\r\n", REQUEST + b"\r\n" + REQUEST])
def test_a_head_that_does_not_end_in_time_is_cut(hasty, sent):
    with open_socket(hasty) as opened:
        opened.sendall(sent)
        if sent.count(b"\r\n\r\n"):
            assert status_of(answer(opened)) == 200
        if sent:
            assert problem_of(answer(opened))["reason"] == "REQUEST_TOO_SLOW"
        assert is_closed(opened)


def test_a_body_that_trickles_is_cut(hasty):
    head = b"POST /v1/scenes/demo/render HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100000\r\nX-API-Key: "
    with open_socket(hasty) as opened:
        opened.sendall(head + KEY.encode() + b"\r\n\r\n")
        with contextlib.suppress(ConnectionError):
            while True:
                opened.sendall(b" " * 50)
                time.sleep(0.1)


def test_a_body_at_the_least_rate_is_taken(hasty):
    body = json.dumps({"pose": {"matrix": np.eye(4).tolist()}, "height": 8, "width": 8}).encode().ljust(6000)
    head = f"POST /v1/scenes/demo/render HTTP/1.1\r\nHost: localhost\r\nContent-Length: {len(body)}\r\nX-API-Key: {KEY}"
    with open_socket(hasty) as opened:
        opened.sendall(f"{head}\r\n\r\n".encode())
        for start in range(0, len(body), 1000):
            opened.sendall(body[start : start + 1000])
            time.sleep(0.3)
        assert status_of(answer(opened)) == 200


@pytest.mark.parametrize("length", [b"Transfer-Encoding: chunked", b"Content-Length: %d" % 2**30])
def test_an_answer_before_the_end_of_a_long_body_says_that_it_ends_the_connection(limited, length):
    with open_socket(limited) as opened:
        opened.sendall(b"POST /v1/scenes/demo/render HTTP/1.1\r\nHost: localhost\r\n" + length + b"\r\n\r\n")
        opened.sendall(b"10000\r\n" + b" " * 2**16 + b"\r\n")  # without a key: refused whatever the body is
        assert problem_of(answer(opened))["status"] == 401
        assert is_closed(opened)


def test_an_answer_before_the_end_of_a_short_body_keeps_the_connection(limited):
    with open_socket(limited) as opened:
        opened.sendall(b"POST /v1/scenes/demo/render HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100000\r\n\r\n")
        early = answer(opened)
        assert (status_of(early), b"connection: close" in early.lower()) == (401, False)
        opened.sendall(b" " * 100000 + REQUEST + b"\r\n")
        assert status_of(answer(opened)) == 200


def test_an_idle_connection_is_closed(hasty):
    with open_socket(hasty) as opened:
        opened.sendall(REQUEST + b"\r\n")
        assert status_of(answer(opened)) == 200
        assert is_closed(opened)


def test_a_client_that_does_not_take_its_answer_is_cut(hasty):
    body = {"pose": {"matrix": np.eye(4).tolist()}, "height": 2048, "width": 2048, "dtype": "float32"}
    content = json.dumps(body).encode()
    head = f"POST /v1/scenes/demo/render HTTP/1.1\r\nHost: localhost\r\nContent-Length: {len(content)}\r\nX-API-Key: "
    wait_until(lambda: connections(hasty) == 0, within_s=TIMEOUT_S)
    with contextlib.ExitStack() as opened:
        for _ in range(4):
            stalled = opened.enter_context(open_socket(hasty, SO_RCVBUF=4096))
            stalled.sendall(head.encode() + KEY.encode() + b"\r\n\r\n" + content)
            assert stalled.recv(1, socket.MSG_PEEK)  # the answer has begun
        wait_until(lambda: connections(hasty) == 0, within_s=3 * TIMEOUT_S, every_s=0.2)


def connections(service):
    """Connections to the HTTP port that the service holds; those of the question are among them."""
    port = f":{urlsplit(service.http).port:04X}"
    with open("/proc/net/tcp") as table:
        rows = [line.split() for line in table.readlines()[1:]]
    return sum(row[1].endswith(port) and row[3] == "01" for row in rows)


def test_a_full_address_leaves_room_for_others(limited):
    wait_until(lambda: connections(limited) == 0, within_s=TIMEOUT_S)
    with contextlib.ExitStack() as opened:
        mine = [opened.enter_context(open_socket(limited, "127.0.0.2")) for _ in range(PER_ADDRESS + 1)]
        problem = problem_of(answer(mine[-1]))
        assert (problem["status"], problem["reason"]) == (503, "TOO_MANY_CONNECTIONS")
        assert is_closed(mine[-1])
        other = opened.enter_context(open_socket(limited, "127.0.0.3"))
        other.sendall(REQUEST + b"\r\n")
        assert status_of(answer(other)) == 200
    with open_socket(limited, "127.0.0.2") as again:
        again.sendall(REQUEST + b"\r\n")
        assert status_of(answer(again)) == 200


def test_connections_are_capped_in_all(limited):
    wait_until(lambda: connections(limited) == 0, within_s=TIMEOUT_S)
    with contextlib.ExitStack() as opened:
        for number in range(TOTAL):
            opened.enter_context(open_socket(limited, f"127.0.1.{1 + number // 10}"))
        surplus = opened.enter_context(open_socket(limited, "127.0.1.99"))
        assert problem_of(answer(surplus))["reason"] == "TOO_MANY_CONNECTIONS"
    wait_until(lambda: connections(limited) == 0, within_s=TIMEOUT_S)


def test_streams_count_as_connections(limited):
    wait_until(lambda: connections(limited) == 0, within_s=TIMEOUT_S)
    address = limited.stream_url()
    with contextlib.ExitStack() as opened:
        for _ in range(PER_ADDRESS):
            opened.enter_context(connect(address, additional_headers={"X-API-Key": KEY}, close_timeout=0.2))
        with open_socket(limited) as surplus:
            assert problem_of(answer(surplus))["reason"] == "TOO_MANY_CONNECTIONS"
    wait_until(lambda: httpx.get(f"{limited.http}/v1/health/live", timeout=300).is_success, within_s=TIMEOUT_S)


@pytest.mark.parametrize("asked", [REQUEST + b"\r\n", REQUEST + b"\r\n" + b"no request\r\n\r\n"])
def test_answers_to_a_client_that_has_said_its_last_word_are_no_faults(limited, asked):
    """The connection closes while the first of its requests is being answered, and the next ones wait."""
    for count in range(100):
        with open_socket(limited) as client, contextlib.suppress(ConnectionError):
            client.sendall((REQUEST + b"\r\n") * (count % 5) + asked)
            client.shutdown(socket.SHUT_WR)
            while client.recv(65536):
                pass
    assert "Traceback" not in limited.log_path.read_text()
