"""An S3 server (moto's, in a process of its own), and a proxy before it that breaks what a test tells it to break."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections import deque
from dataclasses import dataclass

import pytest

from .waiting import Deadline

AWAY_S = float(os.environ.get("ULTRAGRAY_AWAY_S", "6"))  # that tests take the server away; make test-replicas: a minute
_START_TIMEOUT_S = 300.0
_SLOW_DOWN = (
    b"<?xml version='1.0'?><Error><Code>SlowDown</Code><Message>Please reduce your request rate.</Message></Error>"
)


class ObjectServer:
    """moto's S3 on a free port of 127.0.0.1."""

    def __init__(self):
        """Skips the test where moto or obstore is not installed."""
        for needed in ("moto", "obstore"):
            pytest.importorskip(needed)
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(self.port)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        self._buckets = 0
        end = Deadline(_START_TIMEOUT_S)
        while True:
            try:
                self._ask("GET", "moto-api/")
                return
            except OSError:
                assert self._process.poll() is None
                assert not end.passed
                time.sleep(0.1)

    def create_bucket(self):
        """The name of a new, empty bucket."""
        self._buckets += 1
        name = f"bucket-{os.getpid()}-{self._buckets}"
        self._ask("PUT", name)
        return name

    def pause(self):
        """Whoever asks hears nothing any more."""
        self._process.send_signal(signal.SIGSTOP)

    def resume(self):
        """Answers again, what was asked meanwhile too."""
        self._process.send_signal(signal.SIGCONT)

    def remove(self):
        self._process.kill()
        self._process.wait(300)

    def _ask(self, method, path):
        request = urllib.request.Request(f"http://127.0.0.1:{self.port}/{path}", method=method)
        urllib.request.build_opener(urllib.request.ProxyHandler({})).open(request, timeout=10).close()


@dataclass(frozen=True)
class Fault:
    """What happens to the next request of a method (None: of any).

    `answer`: a status instead of an answer; `silence`: no answer; `cut_answer`, `cut_request`: the connection ends
    after so many bytes; `lost_answer`: the request is done, the connection ends without an answer.
    """

    kind: str
    method: str | None = None
    status: int = 503
    bytes: int = 0


class FaultyProxy:
    """Passes requests on to a server, one a connection, but for the faults that are waiting."""

    def __init__(self, port):
        self._upstream = ("127.0.0.1", port)
        self.faults = deque()
        self.requests = []  # the first line of each
        self.away = False  # every connection ends at once
        self._held = []
        self._listener = socket.create_server(("127.0.0.1", 0), backlog=128)
        self.port = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self):
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for one in self._held:
            one.close()

    def _accept(self):
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client):
        if self.away:
            client.close()
            return
        with contextlib.suppress(OSError), client.makefile("rb") as reading:
            head = [line for line in iter(reading.readline, b"\r\n") if line]
            if not head:
                client.close()
                return
            self.requests.append(head[0].decode().strip())
            lengths = [int(line.split(b":")[1]) for line in head if line.lower().startswith(b"content-length:")]
            fault = self._next_fault(head[0].split(b" ")[0].decode())
            if fault is not None and fault.kind == "silence":
                self._held.append(client)
                return
            body = reading.read(sum(lengths))
            if fault is not None and fault.kind == "answer":
                head_of_answer = f"HTTP/1.1 {fault.status} Slow Down\r\nContent-Length: {len(_SLOW_DOWN)}\r\n"
                client.sendall(head_of_answer.encode() + b"Connection: close\r\n\r\n" + _SLOW_DOWN)
            else:
                self._pass_on(client, head, body, fault)
        if client not in self._held:
            client.close()

    def _pass_on(self, client, head, body, fault):
        kept = [line for line in head if not line.lower().startswith(b"connection:")]
        with socket.create_connection(self._upstream) as server:
            request = b"".join([*kept, b"Connection: close\r\n\r\n", body])
            if fault is not None and fault.kind == "cut_request":
                server.sendall(request[: len(request) - len(body) + fault.bytes])
                return
            server.sendall(request)
            left = fault.bytes if fault is not None and fault.kind == "cut_answer" else None
            while part := server.recv(65536):
                if fault is not None and fault.kind == "lost_answer":
                    continue
                client.sendall(part if left is None else part[:left])
                if left is not None:
                    left -= len(part)
                    if left <= 0:
                        return

    def _next_fault(self, method):
        for fault in list(self.faults):
            if fault.method in (None, method):
                self.faults.remove(fault)
                return fault
        return None


@pytest.fixture(scope="session")
def object_server():
    """One S3 server for all tests: they make buckets of their own in it."""
    server = ObjectServer()
    yield server
    server.remove()


@pytest.fixture
def object_proxy(object_server, monkeypatch):
    """The proxy through which this process, and those that it starts, ask the S3 server."""
    proxy = FaultyProxy(object_server.port)
    for name, value in credentials(proxy.port).items():
        monkeypatch.setenv(name, value)
    yield proxy
    proxy.close()


@pytest.fixture
def new_bucket(object_server, object_proxy):
    """Makes the URL of an empty bucket."""
    return lambda: f"s3://{object_server.create_bucket()}/of/tests"


def credentials(port):
    """The environment variables by which obstore finds the S3 server at a port of this machine."""
    return {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
        "AWS_ALLOW_HTTP": "true",
        "AWS_ACCESS_KEY_ID": "key-of-tests",
        "AWS_SECRET_ACCESS_KEY": "secret-of-tests",
        "AWS_REGION": "us-east-1",
    }
