"""An OpenIGTLink client that sends a pose and waits for its image, as a control loop does."""

from __future__ import annotations

import socket

from ultragray.geometry.probe import FloatArray
from ultragray_service.igtl.contents import Image, pack_transform, unpack_image, unpack_status
from ultragray_service.igtl.messages import HEADER_BYTES, Message, pack_message, unpack_header, unpack_message
from ultragray_workers.errors import NotReady

_TIMEOUT_S = 60.0


class PingPong:
    """One connection to a server on this machine."""

    def __init__(self, port: int, device_name: str) -> None:
        self._device_name = device_name
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=_TIMEOUT_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._file = self._socket.makefile("rb")

    def __enter__(self) -> PingPong:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        self._socket.close()

    def render(self, pose: FloatArray) -> Image:  # [4, 4] mm
        """The image of a pose, its checksum checked. Raises NotReady where the server answers otherwise."""
        self._socket.sendall(pack_message(Message("TRANSFORM", self._device_name, pack_transform(pose))))
        header = unpack_header(self._file.read(HEADER_BYTES))
        answer = unpack_message(header, self._file.read(header.body_bytes))
        if answer.type_name != "IMAGE":
            raise NotReady(f"the benchmark's image failed: {unpack_status(answer.content).text}")
        return unpack_image(answer.content)
