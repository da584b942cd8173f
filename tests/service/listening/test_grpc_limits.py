"""One client cannot lock the others out of gRPC."""

import contextlib
import resource
import socket
import time

import grpc
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

from ...waiting import wait_until

TOTAL, PER_ADDRESS = 40, 10
TIMEOUT_S = 300.0
PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + b"\0\0\0\4\0\0\0\0\0"  # with empty SETTINGS


@pytest.fixture(scope="module")
def limited(start_service):
    return start_service(
        max_connections=TOTAL, max_connections_per_address=PER_ADDRESS, header_timeout_s=2, idle_timeout_s=3
    )


def open_socket(service, source):
    host, port = service.grpc.rsplit(":", 1)
    return socket.create_connection((host, int(port)), timeout=TIMEOUT_S, source_address=(source, 0))


def is_open(connection):
    connection.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        try:
            while connection.recv(65536):
                pass
        except ConnectionError:
            pass
        return False
    return True


def answers(service):
    """Whether a new client is answered. Clients of a test before may be counted for a moment longer."""
    options = [("grpc.use_local_subchannel_pool", 1)]
    with grpc.insecure_channel(service.grpc, options=options) as channel:
        try:
            health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest(), timeout=TIMEOUT_S)
        except grpc.RpcError:
            return False
    return True


def test_connections_of_one_address_are_capped_and_others_come_in(limited):
    with contextlib.ExitStack() as opened:
        early = [opened.enter_context(open_socket(limited, "127.0.0.2")) for _ in range(PER_ADDRESS // 2)]
        for connection in early:
            connection.sendall(PREFACE)
        time.sleep(1.0)  # they are known by now
        late = [opened.enter_context(open_socket(limited, "127.0.0.2")) for _ in range(TOTAL)]
        for connection in late:
            with contextlib.suppress(ConnectionError):
                connection.sendall(PREFACE)
        wait_until(lambda: sum(map(is_open, early + late)) <= PER_ADDRESS, within_s=TIMEOUT_S)
        wait_until(lambda: answers(limited), within_s=TIMEOUT_S)


def test_a_connection_that_never_speaks_http2_is_cut(limited):
    with open_socket(limited, "127.0.0.3") as silent, open_socket(limited, "127.0.0.3") as foreign:
        foreign.sendall(PREFACE[:-9])
        wait_until(lambda: not is_open(silent) and not is_open(foreign), within_s=TIMEOUT_S)


def test_an_idle_connection_is_closed(limited):
    with open_socket(limited, "127.0.0.4") as idle:
        idle.sendall(PREFACE)
        wait_until(lambda: not is_open(idle), within_s=TIMEOUT_S)


@pytest.mark.parametrize("size", [70_000, 5_000_000])
def test_long_metadata_is_refused(limited, size):
    options = [("grpc.use_local_subchannel_pool", 1)]
    with grpc.insecure_channel(limited.grpc, options=options) as channel:
        check = health_pb2_grpc.HealthStub(channel).Check
        with pytest.raises(grpc.RpcError) as caught:
            check(health_pb2.HealthCheckRequest(), metadata=(("x-long", "a" * size),), timeout=TIMEOUT_S)
        assert caught.value.code() == grpc.StatusCode.RESOURCE_EXHAUSTED
    wait_until(lambda: answers(limited), within_s=TIMEOUT_S)


def test_clients_that_come_and_go_leave_no_place_taken(limited):
    for _ in range(3 * PER_ADDRESS):
        wait_until(lambda: answers(limited), within_s=TIMEOUT_S)


def test_a_want_of_open_files_does_not_end_the_watch_over_connections(start_service):
    service = start_service(max_connections=TOTAL, max_connections_per_address=PER_ADDRESS)
    limits = resource.prlimit(service.process.pid, resource.RLIMIT_NOFILE)
    resource.prlimit(service.process.pid, resource.RLIMIT_NOFILE, (3, limits[1]))
    try:
        wait_until(lambda: service.logged("connections to port", "failed, and goes on"))
    finally:
        resource.prlimit(service.process.pid, resource.RLIMIT_NOFILE, limits)
    wait_until(lambda: service.logged("connections to port", "is in order again"))
    with contextlib.ExitStack() as opened:
        sockets = [opened.enter_context(open_socket(service, "127.0.0.2")) for _ in range(PER_ADDRESS + 3)]
        wait_until(lambda: sum(map(is_open, sockets)) == PER_ADDRESS)
