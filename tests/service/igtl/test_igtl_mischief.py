"""What is wrong with messages and connections is told, and does no harm to others."""

import contextlib
import os
import time
from pathlib import Path

import numpy as np
import pytest

from ultragray_service.igtl.connection import MAX_SKIPPED_BYTES, MESSAGE_TIMEOUT_S, SEND_TIMEOUT_S
from ultragray_service.igtl.contents import unpack_status
from ultragray_service.igtl.messages import HEADER_BYTES, Message, pack_message

from ...waiting import wait_until
from .conftest import Peer, moved

MEBIBYTE = 2**20
DROPPED = "ultragray_stream_dropped_poses_total"


def still_serves(peer):
    peer.send_pose(np.eye(4), "demo", timestamp=12345)
    while True:
        answer = peer.receive()
        if answer.type_name == "IMAGE" and answer.timestamp == 12345:
            return


@pytest.mark.parametrize(
    ("type_name", "content", "code", "reason", "text"),
    [
        ("TRANSFORM", bytes(48), 10, "INVALID_POSE", "rotation"),
        ("POSITION", bytes(152), 12, "IGTL_MESSAGE_INVALI", "12 or 24 or 28 bytes, got 152"),  # as of pyigtl
        ("TRANSFORM", bytes(70_000), 12, "IGTL_MESSAGE_INVALI", "at most 65536 bytes"),
        ("SENSOR", bytes(5), 12, "IGTL_MESSAGE_INVALI", "got 'SENSOR'"),
        ("STT_QTDATA", bytes(2), 12, "IGTL_MESSAGE_INVALI", "4 bytes, got 2"),
    ],
)
def test_refusals(peer, type_name, content, code, reason, text):
    answer = peer.ask(type_name, "x", content, timestamp=3)
    status = unpack_status(answer.content)
    assert (answer.type_name, answer.device_name, answer.timestamp) == ("STATUS", "x", 3)
    assert (status.code, status.name) == (code, reason)
    assert text in status.text
    still_serves(peer)


def test_a_wrong_checksum_is_told_and_the_connection_stays(peer, igtl_service):
    before = igtl_service.metric('ultragray_stream_frame_errors_total{reason="IGTL_MESSAGE_INVALID"}')
    data = bytearray(pack_message(Message("TRANSFORM", "demo", bytes(48))))
    data[-1] ^= 1
    peer.socket.sendall(data)
    status = peer.status()
    assert (status.code, status.sub_code) == (9, 400)
    assert "CRC-64" in status.text
    still_serves(peer)
    assert igtl_service.metric('ultragray_stream_frame_errors_total{reason="IGTL_MESSAGE_INVALID"}') == before + 1


def test_answers_of_the_client_are_heard_in_silence(peer):
    for type_name in ("STATUS", "CAPABILITY", "RTS_IMAGE"):
        peer.send(type_name, "x", bytes(40))
    assert peer.ask("GET_STATUS", "end").device_name == "end"


@pytest.mark.parametrize("type_name", ["TRANSFORM", "IMAGE"])
@pytest.mark.parametrize("size", [2**63, MAX_SKIPPED_BYTES + 1])
def test_a_size_beyond_all_bounds_is_refused_without_memory(connect, igtl_service, type_name, size):
    peer = connect()
    before = igtl_service.resident_bytes()
    header = bytearray(pack_message(Message(type_name, "x"))[:HEADER_BYTES])
    header[42:50] = size.to_bytes(8, "big")
    peer.socket.sendall(header)
    assert f"got {size}" in peer.status().text
    assert peer.is_closed()
    assert igtl_service.resident_bytes() - before < 20 * MEBIBYTE
    still_serves(connect())


@pytest.mark.long
def test_a_message_that_does_not_end_is_cut_off(connect):
    idle, slow = connect(), connect()
    data = pack_message(Message("TRANSFORM", "demo", bytes(48)))
    sent = 0
    with contextlib.suppress(ConnectionError):
        for byte in data:  # each comes in time, the whole does not
            slow.socket.sendall(bytes([byte]))
            sent += 1
            time.sleep(2.0 * MESSAGE_TIMEOUT_S / len(data))
    assert sent < len(data)
    still_serves(idle)  # silence between messages is nothing bad


def test_a_reader_that_stops_costs_bounded_memory_and_nobody_a_frame(connect, igtl_service):
    stopped, healthy = connect(SO_RCVBUF=4096), connect()
    stopped.ask("STT_IMAGE", "")
    still_serves(healthy)
    before = igtl_service.resident_bytes()
    dropped = igtl_service.metric(DROPPED)
    for count in range(4000):
        stopped.send_pose(moved(count / 1000))
        if count % 100 == 0:
            still_serves(healthy)
    wait_until(lambda: igtl_service.metric(DROPPED) - dropped > 1000)  # the last of them wait in the kernel's buffers
    assert igtl_service.resident_bytes() - before < 20 * MEBIBYTE


def held(service, peers):
    """How many of the service's descriptors are its ends of these connections."""
    ports = {peer.socket.getsockname()[1] for peer in peers}
    entries = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    inodes = {f"socket:[{entry[9]}]" for entry in entries if int(entry[2].rpartition(":")[2], 16) in ports}
    found = 0
    for path in Path(f"/proc/{service.process.pid}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # closed since it was listed
            found += os.readlink(path) in inodes
    return found


@pytest.mark.long
def test_a_reader_that_stops_for_long_is_cut_off(connect, igtl_service):
    peers = [connect(SO_RCVBUF=4096), connect(SO_RCVBUF=4096)]
    wait_until(lambda: held(igtl_service, peers) == 2)
    for count in range(60):  # more images than the kernel's buffers hold
        for peer in peers:
            peer.send_pose(moved(count / 1000), "large")
        time.sleep(0.1)
    peers[1].socket.sendall(bytes(HEADER_BYTES))  # dismissed, but it does not take the reason
    wait_until(lambda: not held(igtl_service, peers), within_s=SEND_TIMEOUT_S + 20, every_s=0.5)


def test_more_connections_than_allowed_are_told_so(start_service):
    service = start_service(igtl_port=0, max_connections=30, max_connections_per_address=20)
    address = next(record["igtl"] for record in service.log() if "igtl" in record)
    with contextlib.ExitStack() as opened:

        def connect(source):
            peer = Peer(address, source=source)
            opened.enter_context(peer.socket)
            return peer

        peers = [connect("127.0.0.2") for _ in range(20)]
        still_serves(peers[-1])
        surplus = connect("127.0.0.2")
        assert surplus.status().code == 6
        assert surplus.is_closed()
        others = [connect("127.0.0.3") for _ in range(10)]
        still_serves(others[-1])
        assert connect("127.0.0.4").status().code == 6
        for peer in peers:
            peer.socket.close()

        def is_let_in():
            late = connect("127.0.0.2")
            late.send("GET_STATUS")
            return late.status().code == 1

        wait_until(is_let_in)
