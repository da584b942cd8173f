"""WebSockets that begin oddly, and frames that carry nothing: nobody else waits for them, and no place is lost."""

import contextlib
import socket
import struct
from urllib.parse import urlsplit

import pytest
from websockets.sync.client import connect

TIMEOUT_S = 300.0
REQUEST = b"GET /v1/health/live HTTP/1.1\r\nHost: localhost\r\n\r\n"
HANDSHAKE = (
    b"GET /v1/scenes/demo/stream HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
)


@pytest.fixture
def opened(service):
    parts = urlsplit(service.http)
    with socket.create_connection((parts.hostname, parts.port), timeout=TIMEOUT_S) as one:
        yield one


def statuses(opened, count):
    """Of so many answers, all with a body of a told length."""
    found, data = [], b""
    while len(found) < count:
        while b"\r\n\r\n" not in data:
            data += opened.recv(65536)
        head, _, data = data.partition(b"\r\n\r\n")
        found.append(int(head.split(b" ", 2)[1]))
        length = next(int(line[15:]) for line in head.lower().split(b"\r\n") if line.startswith(b"content-length:"))
        while len(data) < length:
            data += opened.recv(65536)
        data = data[length:]
    return found


@pytest.mark.parametrize(
    ("begin", "frame"),
    [(b"", b"\x89\x80abcd"), (b"", b"\x8a\x80abcd"), (b"\x01\x80abcd", b"\x00\x80abcd")],
    ids=["pings", "pongs", "fragments"],
)
def test_a_flood_of_frames_that_carry_nothing_is_closed(opened, begin, frame):
    opened.sendall(HANDSHAKE + b"\r\n")
    assert opened.recv(65536).startswith(b"HTTP/1.1 101")
    received = b""
    with contextlib.suppress(ConnectionError):
        opened.sendall(begin + frame * 200_000)
    with contextlib.suppress(ConnectionError):
        while block := opened.recv(65536):
            received += block
    assert len(received) < 1000  # 100 pongs of 2 bytes, and the close frame
    assert not received or struct.pack("!H", 1008) in received  # it may be lost with what was still coming


def test_a_client_that_pings_now_and_then_goes_on(service):
    with connect(f"{service.http.replace('http', 'ws')}/v1/scenes/demo/stream") as connection:
        for _ in range(90):
            assert connection.ping().wait(TIMEOUT_S)


@pytest.mark.parametrize("body", [b"Content-Length: 5\r\n\r\nhello", b"Transfer-Encoding: chunked\r\n\r\n0\r\n\r\n"])
def test_a_handshake_with_a_body_is_an_ordinary_request(opened, body):
    opened.sendall(HANDSHAKE + body)
    assert statuses(opened, 1) == [404]


def test_answers_that_are_due_before_a_handshake_come_before_its_own(opened):
    opened.sendall(REQUEST + REQUEST + HANDSHAKE + b"\r\n" + REQUEST)
    assert statuses(opened, 4) == [200, 200, 404, 200]
