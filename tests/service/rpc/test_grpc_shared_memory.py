"""Streams whose frames go through memory that the client shares, laid out as rendering.proto says."""

import asyncio
import errno
import os
import secrets
import socket
from pathlib import Path

import grpc
import pytest
import uvloop

from ultragray.errors import InvalidArgument
from ultragray_proto.v1 import rendering_pb2
from ultragray_service.core.streams import MAX_MESSAGE_BYTES
from ultragray_service.rpc.calls import address_of
from ultragray_service.rpc.rendering import _Socket
from ultragray_service.rpc.shared_memory import FOLDER, SharedMemory

from ...file_sizes import files_of_at_most
from ...waiting import wait_until
from .test_grpc_render import Conversation, error_info, moved

SLOT_BYTES = 2**20
HEADER_BYTES, FLAGS = 4096, 32  # where the slots begin, and the bytes that say which are free
LOCAL_PEER = "ipv4:127.0.0.1:50000"


class ClientMemory:
    """A client's file, by the words of rendering.proto."""

    def __init__(self, slots=3):
        self.path = Path(FOLDER, f"ultragray-{secrets.token_hex(16)}")
        self.message = rendering_pb2.SharedMemory(
            name=self.path.name, token=secrets.token_bytes(32), slots=slots, slot_bytes=SLOT_BYTES
        )
        self.file = os.fdopen(os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600), "r+b", buffering=0)
        self.file.truncate(HEADER_BYTES + slots * SLOT_BYTES)
        self.write(0, self.message.token + b"\1" * slots)

    def write(self, offset, data):
        os.pwrite(self.file.fileno(), data, offset)

    @property
    def flags(self):
        return os.pread(self.file.fileno(), self.message.slots, FLAGS)

    def free(self, slot):
        self.write(FLAGS + slot, b"\1")

    def pixels(self, frame):
        """The data of a frame that came here."""
        assert frame.HasField("shared_data"), frame.error
        assert not frame.data
        place = HEADER_BYTES + frame.shared_data.slot * SLOT_BYTES
        return os.pread(self.file.fileno(), frame.shared_data.bytes, place)

    def close(self):
        self.file.close()
        self.path.unlink(missing_ok=True)


@pytest.fixture
def memory():
    made = ClientMemory()
    yield made
    made.close()


class ClientSocket:
    """The socket beside a client's file, by the words of rendering.proto."""

    def __init__(self, memory):
        self.path = f"{memory.path}.socket"
        memory.message.has_socket = True
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(self.path)
        self._listener.listen(1)
        self._listener.settimeout(60)

    def accept(self):
        self._end, _ = self._listener.accept()
        self._end.settimeout(60)
        self._received = self._end.makefile("rb")

    def announce(self, size):
        """How many bytes the next message has."""
        self._end.sendall(size.to_bytes(4, "little"))

    def send(self, data):
        self.announce(len(data))
        self._end.sendall(data)

    def ask(self, sequence, **fields):
        self.send(rendering_pb2.RenderStreamRequest(sequence=sequence, **fields).SerializeToString())
        return self.receive()

    def receive(self):
        """The next frame; None after the last one."""
        length = self._received.read(4)
        return rendering_pb2.Frame.FromString(self._received.read(int.from_bytes(length, "little"))) if length else None

    def done_sending(self):
        self._end.shutdown(socket.SHUT_WR)

    def close(self):
        self._received.close()
        self._end.close()
        self._listener.close()


@pytest.fixture
def talk(renders, memory):
    """A stream whose messages go through a socket: its call, and the socket."""
    through = ClientSocket(memory)
    conversation = opened(renders, memory)
    through.accept()
    yield conversation.call, through
    through.close()


def test_messages_go_through_a_socket_and_the_call_ends_with_them(talk, memory):
    call, through = talk
    frames = [through.ask(k, pose=moved(k)) for k in range(5)]
    assert [frame.sequence for frame in frames] == list(range(5))
    assert [frame.HasField("shared_data") for frame in frames] == [True] * 3 + [False] * 2
    assert len({memory.pixels(frame) for frame in frames[:3]} | {frame.data for frame in frames[3:]}) == 5
    assert through.ask(5, pose=moved(0), timeout_ms=-1.0).error.field == "timeout_ms"
    through.done_sending()
    assert through.receive() is None
    assert list(call) == []
    assert call.code() == grpc.StatusCode.OK
    assert not Path(through.path).exists()


def test_what_is_no_message_is_told_and_too_large_a_one_ends_the_poses(talk):
    call, through = talk
    through.send(b"\xff" * 10)
    assert "not a message" in through.receive().error.detail
    assert through.ask(2, pose=moved(0)).sequence == 2
    through.announce(MAX_MESSAGE_BYTES + 1)
    assert f"at most {MAX_MESSAGE_BYTES} bytes, got {MAX_MESSAGE_BYTES + 1}" in through.receive().error.detail
    assert through.receive() is None
    assert call.code() == grpc.StatusCode.OK


def test_a_client_that_is_gone_or_cancels_ends_the_stream(service, renders, memory):
    for end in (lambda call, through: through.close(), lambda call, through: call.cancel()):
        made = ClientMemory()
        through = ClientSocket(made)
        conversation = opened(renders, made)
        through.accept()
        assert through.ask(1, pose=moved(0)).sequence == 1
        wait_until(lambda: service.metric("ultragray_open_streams") == 1)
        end(conversation.call, through)
        wait_until(lambda: service.metric("ultragray_open_streams") == 0)
        through.close()
        made.close()


def test_a_frame_for_a_client_that_is_just_gone_is_no_fault():
    async def run():
        end, far = socket.socketpair()
        with far:
            through = _Socket(end)
            _, writer = await through._opened()
            writer.transport.abort()  # as uvloop does when it finds the client gone
            await asyncio.sleep(0.01)
            await through.write(b"a frame")
            await through.close(at_once=True)

    loop = uvloop.new_event_loop()
    loop.run_until_complete(run())
    loop.close()


def test_a_socket_that_is_not_there_is_refused(renders, memory):
    memory.message.has_socket = True
    told, detail = refused(renders, memory.message)
    assert told == "shared_memory.name"
    assert "cannot connect to its socket: No such file" in detail


def opened(renders, memory, **settings):
    conversation = Conversation(renders)
    asked = rendering_pb2.RenderSettings(**{"scene": "demo", **settings})
    conversation.send(settings=asked, shared_memory=memory.message)
    return conversation


def test_a_slot_is_written_again_only_once_it_is_free(renders, memory):
    conversation = opened(renders, memory)
    frames = [conversation.ask(k, pose=moved(k)) for k in range(3)]
    assert [frame.shared_data.slot for frame in frames] == [0, 1, 2]
    assert memory.flags == b"\0\0\0"
    held = [memory.pixels(frame) for frame in frames]
    beyond = conversation.ask(3, pose=moved(3))
    assert (len(beyond.data), beyond.HasField("shared_data")) == (len(held[0]), False)
    memory.free(1)
    again = conversation.ask(4, pose=moved(4))
    assert again.shared_data.slot == 1
    assert [memory.pixels(frame) for frame in frames] == [held[0], memory.pixels(again), held[2]]
    assert len({*held, beyond.data, memory.pixels(again)}) == 5
    conversation.finish()


def test_a_frame_larger_than_a_slot_comes_in_its_message(renders, memory):
    conversation = opened(renders, memory, height=600, width=600, encoding=rendering_pb2.ENCODING_FLOAT32)
    assert len(conversation.ask(1, pose=moved(0)).data) == 600 * 600 * 4
    assert memory.flags == b"\1\1\1"
    conversation.finish()


def test_a_file_that_is_cut_off_or_scribbled_on_harms_its_client_alone(service, renders, memory):
    conversation = opened(renders, memory)
    expected = memory.pixels(conversation.ask(1, pose=moved(1)))
    memory.file.truncate(0)
    assert conversation.ask(2, pose=moved(1)).data == expected  # no byte says that a slot is free
    memory.free(2)
    assert memory.pixels(conversation.ask(3, pose=moved(1))) == expected
    memory.write(0, b"\xff" * HEADER_BYTES)
    assert conversation.ask(4, pose=moved(1)).data == expected
    conversation.finish()
    assert service.process.poll() is None


def refused(renders, message):
    """The field that a call is refused for, and why."""
    conversation = Conversation(renders)
    settings = rendering_pb2.RenderSettings(scene="demo")
    conversation.send(1, settings=settings, pose=moved(0), shared_memory=message)
    with pytest.raises(grpc.RpcError) as caught:
        next(conversation.call)
    assert caught.value.code() == grpc.StatusCode.INVALID_ARGUMENT
    return error_info(caught.value)[0].metadata["field"], caught.value.details()


BAD_MESSAGES = {
    "no name": ({"name": ""}, "name", "hexadecimal"),
    "a path": ({"name": "/etc/passwd"}, "name", "hexadecimal"),
    "a line after the name": ({"name": f"ultragray-{'0' * 32}\n"}, "name", "hexadecimal"),
    "a file that is not there": ({"name": f"ultragray-{'0' * 32}"}, "name", "No such file"),
    "another token": ({"token": b"0" * 32}, "name", "begin with the token"),
    "many slots": ({"slots": 65}, "slots", "from 1 to 64, got 65"),
    "fewer slots": ({"slots": 2}, "name", "must have 2101248 bytes, got 3149824"),
    "half a page": ({"slot_bytes": 2**20 + 2048}, "slot_bytes", "multiple of 4096"),
    "a large slot": ({"slot_bytes": 2**24 + 4096}, "slot_bytes", "at most 16777216"),
    "a large size": ({"slot_bytes": 2**28 // 3 // 4096 * 4096 + 4096}, "slot_bytes", "at most 268435456 for all"),
}


@pytest.mark.parametrize(("changes", "field", "words"), BAD_MESSAGES.values(), ids=BAD_MESSAGES)
def test_what_a_message_must_tell(renders, memory, changes, field, words):
    message = rendering_pb2.SharedMemory()
    message.CopyFrom(memory.message)
    for name, value in changes.items():
        setattr(message, name, value)
    told, detail = refused(renders, message)
    assert told == f"shared_memory.{field}"
    assert words in detail
    assert memory.path.exists()
    assert memory.flags == b"\1\1\1"


def as_link(path):
    path.rename(path.with_suffix(".moved"))
    path.symlink_to(path.with_suffix(".moved"))


def as_folder(path):
    path.unlink()
    path.mkdir()


def as_pipe(path):
    path.unlink()
    os.mkfifo(path)


def as_file_of_another_user(path):
    if os.geteuid() != 0:
        pytest.skip("only root can give files away")
    os.chown(path, 65534, 65534)


@pytest.mark.parametrize("become", [as_link, as_folder, as_pipe, as_file_of_another_user])
def test_only_a_file_of_the_own_user_is_opened(renders, memory, become):
    try:
        become(memory.path)
        assert refused(renders, memory.message)[0] == "shared_memory.name"
        assert memory.flags == b"\1\1\1"
    finally:
        memory.path.with_suffix(".moved").unlink(missing_ok=True)
        if memory.path.is_dir():
            memory.path.rmdir()


def test_a_file_is_opened_once(renders, memory):
    conversation = opened(renders, memory)
    memory.pixels(conversation.ask(1, pose=moved(0)))
    assert refused(renders, memory.message)[0] == "shared_memory.name"
    memory.pixels(conversation.ask(2, pose=moved(0)))
    conversation.finish()


def test_addresses_of_peers():
    assert address_of("ipv4:127.0.0.1:50000") == "127.0.0.1"
    assert address_of("ipv6:%5Bfd00::1%5D:50000") == "fd00::1"
    assert address_of("unix:") == ""


@pytest.mark.parametrize("peer", ["ipv4:10.0.0.7:50000", "ipv6:%5Bfd00::1%5D:50000", "unix:", ""])
def test_no_file_is_looked_for_on_behalf_of_other_peers(memory, peer):
    with pytest.raises(InvalidArgument, match="loopback"):
        SharedMemory(memory.message, peer)
    assert memory.path.exists()


@pytest.mark.parametrize("peer", [LOCAL_PEER, "ipv6:%5B::1%5D:50000"])
def test_a_loopback_address_is_that_of_either_protocol(memory, peer):
    SharedMemory(memory.message, peer).close()
    assert not memory.path.exists()


def test_a_service_without_another_socket_refuses_it(memory, monkeypatch):
    def none_left(family):
        raise OSError(errno.EMFILE, "Too many open files")

    memory.message.has_socket = True
    monkeypatch.setattr(socket, "socket", none_left)
    with pytest.raises(InvalidArgument, match="Too many open files") as refused:
        SharedMemory(memory.message, LOCAL_PEER)
    assert refused.value.field == "shared_memory.name"


def test_a_slot_that_cannot_be_written_is_not_lent(memory):
    shared = SharedMemory(memory.message, LOCAL_PEER)
    memory.file.truncate(HEADER_BYTES)
    with files_of_at_most(HEADER_BYTES + 4096):  # like a /dev/shm that is full
        assert shared.lend(8192) is None
    assert memory.flags == b"\1\1\1"
    first, second = shared.lend(8192), shared.lend(SLOT_BYTES)
    assert ((first.slot, first.offset), (second.slot, second.offset)) == ((0, 4096), (1, 4096 + SLOT_BYTES))
    assert shared.lend(SLOT_BYTES + 1) is None
    shared.take_back(first)
    assert memory.flags == b"\1\0\1"
    shared.close()
    assert shared.lend(8192) is None
    shared.take_back(second)
    assert memory.flags == b"\1\0\1"
