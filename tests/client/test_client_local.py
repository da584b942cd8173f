"""The socket that messages of a stream go through on one host: in pieces, and where nobody reads them."""

import gc
import socket
import struct
import threading

import pytest

from ultragray_client.local import LocalCall
from ultragray_proto.v1 import rendering_pb2

POSE = rendering_pb2.RenderStreamRequest(sequence=7)


class OpenCall:
    """In place of a call of gRPC that stays open."""

    def add_callback(self, _):
        return True

    def is_active(self):
        return True

    def cancel(self):
        return True

    def __next__(self):
        raise StopIteration


@pytest.fixture
def connected(tmp_path):
    """A call, and the service's end of its socket."""
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(tmp_path / "socket"))
    listener.listen(1)
    done = threading.Event()

    def messages():
        yield rendering_pb2.RenderStreamRequest()
        done.wait()

    call = LocalCall(lambda opening: next(opening) and OpenCall(), messages(), listener)
    with socket.socket(socket.AF_UNIX) as end:
        end.connect(str(tmp_path / "socket"))
        call._is_settled.wait()
        yield call, end
        done.set()
        call.cancel()


def framed(message):
    data = message.SerializeToString()
    return struct.pack("<I", len(data)) + data


def test_messages_come_whole_however_they_are_cut(connected):
    call, end = connected
    sent = [rendering_pb2.Frame(sequence=1 + number, data=bytes(300 * number)) for number in range(40)]
    stream = b"".join(map(framed, sent))

    def send():
        for first in range(0, len(stream), 7001):
            end.sendall(stream[first : first + 7001])
        end.shutdown(socket.SHUT_WR)

    threading.Thread(target=send).start()
    for expected, received in zip(sent, call, strict=True):
        assert (received.message.sequence, bytes(received.data)) == (expected.sequence, expected.data)


def test_a_call_that_is_dropped_unread_closes_its_socket(tmp_path):
    """Python would warn of a socket that is left to it."""
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(tmp_path / "socket"))
    listener.listen(1)
    opening = iter([rendering_pb2.RenderStreamRequest()])
    call = LocalCall(lambda first: next(first) and OpenCall(), opening, listener)
    with socket.socket(socket.AF_UNIX) as end:
        end.connect(str(tmp_path / "socket"))
        for thread in threading.enumerate():
            if thread.name == "ultragray-local":
                thread.join(10.0)
        del call, thread
        gc.collect()
        end.settimeout(10.0)
        assert end.recv(1) == b""
        with pytest.raises(BrokenPipeError):
            end.send(b"too late")


def test_a_message_goes_at_once_unless_nobody_reads(connected):
    call, end = connected
    assert call.send_at_once(POSE)
    assert end.recv(1000) == framed(POSE)
    sent = 0
    while call.send_at_once(POSE):  # until the socket is full, and then without waiting
        sent += 1
    assert 0 < sent < 100_000
    end.close()
    assert not call.send_at_once(POSE)
