"""Messages of MCAP recordings: decoded without trust, and images among them as grey frames."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap_ros2.decoder import DecoderFactory

from ultragray.datasets.clocks import NS_PER_S
from ultragray.datasets.images import grey_frames
from ultragray.errors import DatasetInvalid
from ultragray.exchange.ros_fields import COMPRESSED, check_fields
from ultragray.exchange.ros_messages import IMAGE

MAX_RECORD_BYTES = 1 << 30  # of a chunk, compressed or not
MAX_TIME_NS = (1 << 63) - 1


@dataclass(frozen=True)
class StoredMessage:
    """A message. `decode` gives its fields as attributes, those of its kind. Raises DatasetInvalid."""

    topic: str
    kind: str  # such as sensor_msgs/msg/Image
    log_time_ns: int
    decode: Callable[[], Any]


class MessageFile:
    """An MCAP file. `broke_off` says, once the messages were read, whether its end is missing."""

    def __init__(self, path: Path) -> None:
        self.path, self.broke_off = path, False
        self._decoders = DecoderFactory()

    def messages(self) -> Iterator[StoredMessage]:
        """Every message, in the order of the file, as far as it goes. Raises DatasetInvalid, OSError."""
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        for record in self._records():
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                channel = channels.get(record.channel_id)
                if channel is None:
                    raise DatasetInvalid(f"{self.path}: a message is of channel {record.channel_id}, which it lacks")
                if record.log_time > MAX_TIME_NS:
                    raise DatasetInvalid(
                        f"{self.path}: a message of {channel.topic} was written {record.log_time} ns after 1970, the "
                        f"limit is {MAX_TIME_NS}"
                    )
                schema = schemas.get(channel.schema_id)
                yield StoredMessage(
                    channel.topic,
                    "" if schema is None else schema.name,
                    record.log_time,
                    partial(self._decoded, record.data, channel, schema),
                )

    def _records(self) -> Iterator[McapRecord]:
        with self.path.open("rb") as file:
            records = StreamReader(file, emit_chunks=True, record_size_limit=MAX_RECORD_BYTES).records
            is_begun = False
            while True:
                try:
                    record = next(records, None)
                    if record is None:
                        return
                    if isinstance(record, Chunk) and record.uncompressed_size > MAX_RECORD_BYTES:
                        raise DatasetInvalid(
                            f"{self.path}: a chunk must have at most {MAX_RECORD_BYTES:,} bytes, it says "
                            f"{record.uncompressed_size:,}"
                        )
                    inner = breakup_chunk(record, validate_crc=True) if isinstance(record, Chunk) else [record]
                except (OSError, MemoryError, DatasetInvalid):
                    raise
                except Exception as error:  # the library has many kinds, for a file that is damaged or broke off
                    if is_begun and file.tell() == os.fstat(file.fileno()).st_size:
                        self.broke_off = True
                        return
                    raise DatasetInvalid(
                        f"{self.path}: it cannot be read as MCAP: {str(error) or 'it ends too early'}"
                    ) from error
                is_begun = True
                yield from inner

    def _decoded(self, data: bytes, channel: Channel, schema: Schema | None) -> Any:
        try:
            decode = self._decoders.decoder_for(channel.message_encoding, schema)
            if decode is not None and schema is not None:
                message = decode(data)
                check_fields(message, schema.name)
                return message
        except MemoryError:
            raise
        except Exception as error:
            raise DatasetInvalid(f"{self.path}: a message of {channel.topic} cannot be decoded: {error}") from error
        raise DatasetInvalid(
            f"{self.path}: messages of {channel.topic} must be of ROS 2 (cdr with a definition in ros2msg), they are "
            f"{channel.message_encoding or 'of no encoding'} with {schema.encoding if schema else 'none'}"
        )


def time_of(header: Any, log_time_ns: int) -> int:
    """The stamp of a std_msgs/Header, ns; where that was left at 0, when the message was written."""
    stamp_ns = int(header.stamp.sec) * NS_PER_S + int(header.stamp.nanosec)
    return stamp_ns or log_time_ns


# Images of ROS 2 as grey frames: sensor_msgs/Image, and CompressedImage with a JPEG or PNG file in it.


KINDS = (IMAGE, COMPRESSED)
_FLAGS = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION

# Channels, and the place of red, green and blue among them; a float is of 0 to 1.
_ENCODINGS: dict[str, tuple[int, tuple[int, ...]]] = {
    "mono8": (1, (0,)),
    "8UC1": (1, (0,)),
    "mono16": (1, (0,)),
    "16UC1": (1, (0,)),
    "32FC1": (1, (0,)),
    "rgb8": (3, (0, 1, 2)),
    "rgba8": (4, (0, 1, 2)),
    "bgr8": (3, (2, 1, 0)),
    "8UC3": (3, (2, 1, 0)),
    "bgra8": (4, (2, 1, 0)),
    "8UC4": (4, (2, 1, 0)),
}
_KINDS = {"32FC1": "f4", "mono16": "u2", "16UC1": "u2"}  # of numbers; else bytes


def grey_image(message: Any, kind: str, where: str) -> np.ndarray:  # [H, W] uint8 or uint16
    """The pixels of a message; colours become their luma. Raises DatasetInvalid, naming `where`."""
    if kind == COMPRESSED:
        return _decompressed(message, where)
    known = _ENCODINGS.get(message.encoding)
    if known is None:
        raise DatasetInvalid(
            f"{where}: its encoding must be one of {', '.join(_ENCODINGS)}, got {message.encoding[:40]!r}"
        )
    channels, colours = known
    pixel = np.dtype((">" if message.is_bigendian else "<") + _KINDS.get(message.encoding, "u1"))
    height, width, step = int(message.height), int(message.width), int(message.step)
    row_bytes = width * channels * pixel.itemsize
    data = np.frombuffer(message.data, np.uint8)
    if min(height, width) < 1 or step < row_bytes or len(data) < (height - 1) * step + row_bytes:
        raise DatasetInvalid(
            f"{where}: {height} rows of {step} bytes must hold {width} pixels of {message.encoding}, it has "
            f"{len(data)} bytes"
        )
    rows = np.lib.stride_tricks.as_strided(data, (height, row_bytes), (step, 1), writeable=False)
    pixels = np.ascontiguousarray(rows).view(pixel).reshape(height, width, channels)[:, :, colours]
    return (
        pixels[:, :, 0].astype(np.uint16)
        if pixel.kind == "u" and pixel.itemsize == 2
        else grey_frames(pixels[None], where)[0]
    )


def _decompressed(message: Any, where: str) -> np.ndarray:
    data = np.frombuffer(message.data, np.uint8)
    try:
        found = cv2.imdecode(data, _FLAGS) if len(data) else None
    except cv2.error:
        found = None
    if found is None or found.dtype not in (np.uint8, np.uint16):
        raise DatasetInvalid(
            f"{where}: it must hold a JPEG or PNG file, got {len(data)} bytes of format {message.format[:40]!r}"
        )
    return np.asarray(found)
