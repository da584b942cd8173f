"""The calls of a stream that shares memory with the service: their messages go through a socket of the host.

HTTP/2 costs a message more than all else between a client and a service on one host. So the call itself carries the
first message alone, and its status at the end; the others go through the socket that the client listens at, beside its
shared memory, each behind its length (rendering.proto). The two classes look to a stream as the calls of gRPC do.
"""

from __future__ import annotations

import asyncio
import socket
import struct
import threading
import weakref
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

from ultragray_client.errors import StreamEnded
from ultragray_client.frames import received_frame

_LENGTH = struct.Struct("<I")
_READ_BYTES = 2**16  # at once: many messages


class LocalCall:
    """A call for threads."""

    def __init__(self, start: Callable[[Iterator[Any]], Any], messages: Iterator[Any], listener: socket.socket) -> None:
        self._listener = listener
        self._socket: socket.socket | None = None
        self._received = bytearray()  # of messages that are not read yet
        self._is_settled = threading.Event()  # the service has connected, or will not
        self._call = start(iter([next(messages)]))
        if not self._call.add_callback(self._hang_up):
            self._hang_up()
        threading.Thread(target=self._send, args=(messages,), name="ultragray-local", daemon=True).start()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._call, name)

    def __iter__(self) -> LocalCall:
        return self

    def __next__(self) -> Any:
        """The next message. After the last one it raises what the call raises then."""
        self._is_settled.wait()
        if self._socket is not None:
            with suppress(OSError):
                if (data := self._read(self._socket)) is not None:
                    return received_frame(data)
            self._close()
        return next(self._call)

    def _read(self, end: socket.socket) -> bytes | None:
        """The bytes of the next message; None after the last one."""
        buffer = self._received
        while True:
            if len(buffer) >= _LENGTH.size and len(buffer) >= (stop := _LENGTH.size + _LENGTH.unpack_from(buffer)[0]):
                data = bytes(memoryview(buffer)[_LENGTH.size : stop])
                del buffer[:stop]
                return data
            if not (some := end.recv(_READ_BYTES)):
                return None
            buffer += some

    def send_at_once(self, message: Any) -> bool:
        """Sends a message from the thread of the caller; False where the socket is not open or would have it wait."""
        if self._socket is None:
            return False
        data = message.SerializeToString()
        data = _LENGTH.pack(len(data)) + data
        try:
            count = self._socket.send(data, socket.MSG_DONTWAIT)
            self._socket.sendall(data[count:])
        except OSError:  # no room, or the call is over: reading tells why
            return False
        return True

    def cancel(self) -> bool:
        cancelled = bool(self._call.cancel())
        self._is_settled.wait()
        self._close()
        return cancelled

    def _send(self, messages: Iterator[Any]) -> None:
        try:
            with self._listener:
                end, _ = self._listener.accept()
            weakref.finalize(self, end.close)  # of a stream that is dropped unread
            self._socket = end
            if not self._call.is_active():
                self._hang_up()
        except OSError:  # the call is over: reading tells why
            return
        finally:
            self._is_settled.set()
        with suppress(OSError):
            for message in messages:
                data = message.SerializeToString()
                self._socket.sendall(_LENGTH.pack(len(data)) + data)
            self._socket.shutdown(socket.SHUT_WR)

    def _close(self) -> None:
        if self._socket is not None:
            with suppress(OSError):
                self._socket.shutdown(socket.SHUT_RDWR)  # wakes whoever reads or writes
            self._socket.close()

    def _hang_up(self) -> None:
        """The call is over: nobody waits for the service any more. What it has sent can still be read."""
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        if self._socket is not None:
            with suppress(OSError):
                self._socket.shutdown(socket.SHUT_RD)


class AsyncLocalCall:
    """A call for asyncio."""

    def __init__(self, call: Any, listener: socket.socket) -> None:
        self._call, self._listener = call, listener
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        self._is_settled = asyncio.Event()
        self._is_opened = False
        call.add_done_callback(self._hang_up)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._call, name)

    async def write(self, message: Any) -> None:
        """Raises StreamEnded where the call is over: reading says why."""
        if not self._is_opened:
            self._is_opened = True
            try:
                await self._call.write(message)
                await self._connect()
            finally:
                self._is_settled.set()
            return
        await self._is_settled.wait()
        if self._streams is None:
            raise StreamEnded("the call is over")
        data = message.SerializeToString()
        try:
            self._streams[1].write(_LENGTH.pack(len(data)) + data)
            await self._streams[1].drain()
        except OSError:
            raise StreamEnded("the call is over") from None

    async def read(self) -> Any:
        """The next message. After the last one it gives, or raises, what the call does then."""
        await self._is_settled.wait()
        if self._streams is not None:
            with suppress(asyncio.IncompleteReadError, OSError):
                length = await self._streams[0].readexactly(_LENGTH.size)
                return received_frame(await self._streams[0].readexactly(*_LENGTH.unpack(length)))
            self._streams[1].close()
        return await self._call.read()

    async def done_writing(self) -> None:
        if self._streams is not None:
            with suppress(OSError):
                self._streams[1].write_eof()

    def cancel(self) -> bool:
        if self._streams is not None:
            self._streams[1].close()
        return bool(self._call.cancel())

    async def _connect(self) -> None:
        """Waits for the service to connect, or for the end of the call: then reading tells why."""
        self._listener.setblocking(False)
        accepting = asyncio.ensure_future(asyncio.get_running_loop().sock_accept(self._listener))
        self._call.add_done_callback(lambda _: accepting.cancel())
        try:
            with suppress(OSError), self._listener:
                await asyncio.wait({accepting})
                if not accepting.cancelled():
                    self._streams = await asyncio.open_unix_connection(sock=accepting.result()[0])
                    if self._call.done():
                        self._hang_up(self._call)
        finally:
            accepting.cancel()

    def _hang_up(self, _: Any) -> None:
        """The call is over. What the service has sent can still be read."""
        if not self._is_opened:
            self._is_settled.set()
        if self._streams is not None:
            with suppress(OSError):
                self._streams[1].get_extra_info("socket").shutdown(socket.SHUT_RD)
