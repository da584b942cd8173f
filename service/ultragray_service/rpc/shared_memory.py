"""Frames in memory that a client on this host shares with its stream; rendering.proto has the layout of the file."""

from __future__ import annotations

import hmac
import os
import re
import socket
import stat
import struct
from contextlib import suppress

from ultragray.errors import InvalidArgument
from ultragray_proto.v1 import rendering_pb2
from ultragray_service.access.principals import is_loopback
from ultragray_service.rpc.calls import address_of
from ultragray_workers.pool.messages import Place

FOLDER = "/dev/shm"
HEADER_BYTES = 4096
TOKEN_BYTES = 32
MAX_SLOTS = 64
PAGE_BYTES = 4096
MAX_BYTES = 256 * 2**20  # of all slots of one stream
MAX_SLOT_BYTES = 16 * 2**20  # allocated within the event loop: some milliseconds

_FIELD = "shared_memory"
_SOCKET = ".socket"  # behind the name of the file
_CREDENTIALS = struct.Struct("3i")  # process, user, group (unix(7))
_NAME = re.compile(r"ultragray-[0-9a-f]{32}")
FREE, _LENT = b"\1", b"\0"


class SharedMemory:
    """The file of one stream. It is written to, never mapped: a client that truncates it harms nobody but itself."""

    def __init__(self, request: rendering_pb2.SharedMemory, peer: str) -> None:
        """Opens the file and removes its name. Raises InvalidArgument for one that the peer may not share."""
        if not is_loopback(address_of(peer)):
            raise InvalidArgument(
                f"{_FIELD} is for clients that reach the service by a loopback address, got one at {peer}", field=_FIELD
            )
        _check_sizes(request)
        self._slots, self._slot_bytes = request.slots, request.slot_bytes
        self._allocated = [0] * request.slots  # bytes of each
        self.socket: socket.socket | None = None  # for the messages of the stream
        path = f"{FOLDER}/{request.name}"
        try:
            self._descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise _refused(request, f"the service cannot open it: {error.strerror}") from None
        try:
            self._check_file(request)
            if request.has_socket:
                self.socket = _connected(request, f"{path}{_SOCKET}")
        except BaseException:
            self.close()
            raise
        with suppress(OSError):
            os.unlink(path)

    def _check_file(self, request: rendering_pb2.SharedMemory) -> None:
        status = os.fstat(self._descriptor)
        expected = HEADER_BYTES + self._slots * self._slot_bytes
        if not stat.S_ISREG(status.st_mode) or status.st_uid != os.geteuid():
            raise _refused(request, "it must be a file of the user that the service runs as")
        if status.st_size != expected:
            raise _refused(request, f"it must have {expected} bytes, got {status.st_size}")
        if not hmac.compare_digest(os.pread(self._descriptor, TOKEN_BYTES, 0), request.token):
            raise _refused(request, "it does not begin with the token")

    def lend(self, size: int) -> Place | None:
        """The first slot that is free, with memory for so many bytes; None where there is no room."""
        if size > self._slot_bytes:
            return None
        try:
            slot = os.pread(self._descriptor, self._slots, TOKEN_BYTES).find(FREE)
            if slot < 0:
                return None
            offset = HEADER_BYTES + slot * self._slot_bytes
            if size > self._allocated[slot]:
                os.posix_fallocate(self._descriptor, offset, size)  # fails here where /dev/shm is full
                self._allocated[slot] = size
            os.pwrite(self._descriptor, _LENT, TOKEN_BYTES + slot)
        except OSError:
            return None
        return Place(slot, size, self._descriptor, offset)

    def take_back(self, place: Place) -> None:
        with suppress(OSError):
            os.pwrite(self._descriptor, FREE, TOKEN_BYTES + place.slot)

    def close(self) -> None:
        """Lets go of the memory; frames that the client has stay where they are. Nothing is put there any more."""
        descriptor, self._descriptor = self._descriptor, -1
        os.close(descriptor)


def _connected(request: rendering_pb2.SharedMemory, path: str) -> socket.socket:
    """The service's end of the client's socket. Raises InvalidArgument."""
    try:
        end = socket.socket(socket.AF_UNIX)
    except OSError as error:
        raise _refused(request, f"the service has no socket for it: {error.strerror}") from None
    try:
        end.setblocking(False)
        end.connect(path)
        _, user, _ = _CREDENTIALS.unpack(end.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
    except OSError as error:
        end.close()
        raise _refused(request, f"the service cannot connect to its socket: {error.strerror}") from None
    if user != os.geteuid():
        end.close()
        raise _refused(request, "its socket must be one of the user that the service runs as")
    with suppress(OSError):
        os.unlink(path)
    return end


def _check_sizes(request: rendering_pb2.SharedMemory) -> None:
    slot_bytes = request.slot_bytes
    fits = 0 < slot_bytes <= MAX_SLOT_BYTES and request.slots * slot_bytes <= MAX_BYTES and slot_bytes % PAGE_BYTES == 0
    whole = f"at most {MAX_SLOT_BYTES}, and at most {MAX_BYTES} for all slots together"
    for part, is_right, expected, value in (
        ("name", _NAME.fullmatch(request.name), "be ultragray- and 32 hexadecimal digits", repr(request.name)),
        ("token", len(request.token) == TOKEN_BYTES, f"have {TOKEN_BYTES} bytes", len(request.token)),
        ("slots", 1 <= request.slots <= MAX_SLOTS, f"be from 1 to {MAX_SLOTS}", request.slots),
        ("slot_bytes", fits, f"be a multiple of {PAGE_BYTES}, {whole}", slot_bytes),
    ):
        if not is_right:
            raise InvalidArgument(f"{_FIELD}.{part} must {expected}, got {value}", field=f"{_FIELD}.{part}")


def _refused(request: rendering_pb2.SharedMemory, why: str) -> InvalidArgument:
    return InvalidArgument(f"{_FIELD} {FOLDER}/{request.name} is refused: {why}", field=f"{_FIELD}.name")
