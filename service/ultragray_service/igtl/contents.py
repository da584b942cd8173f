"""The types of messages and what they hold: poses, instruments, images, states, requests. Numbers are big-endian."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ultragray.errors import (
    InvalidPose,
    UltragrayError,
)
from ultragray.geometry.pose import check_poses, pose_from_position_quaternion, quaternion_from_pose
from ultragray.geometry.probe import FloatArray
from ultragray_service.errors import (
    IgtlMessageInvalid,
    TooManyConnections,
    statuses_of,
)
from ultragray_service.igtl.messages import DEVICE_NAME_BYTES, pack_text, unpack_text
from ultragray_workers.errors import (
    Draining,
)

POSE_TYPES = ("TRANSFORM", "POSITION", "TDATA", "QTDATA")
COMMAND_TYPES = ("COMMAND", "STRING")

KINDS: Mapping[str, str] = {  # by what stands behind GET_, STT_ and STP_: a type has at most 12 letters
    "IMAGE": "IMAGE",
    "VIDEO": "VIDEO",
    "TRANSFOR": "TRANSFORM",
    "TRANS": "TRANSFORM",  # in older documents of the protocol
    "POSITION": "POSITION",
    "TDATA": "TDATA",
    "QTDATA": "QTDATA",
}

_PREFIXES = ("GET_", "STT_", "STP_")
CAPABILITY = (
    *POSE_TYPES,
    *COMMAND_TYPES,
    "GET_CAPABIL",
    "GET_STATUS",
    *(f"{prefix}{suffix}" for suffix in KINDS if suffix != "TRANS" for prefix in _PREFIXES),
)
UNDERSTOOD = frozenset({*CAPABILITY, *(f"{prefix}TRANS" for prefix in _PREFIXES)})

HEARD = ("STATUS", "CAPABILITY", "RTS_")  # beginnings of types that are answers themselves


TYPE_NAME_BYTES = 12

_MATRIX = np.dtype((">f4", 12))  # the columns of a [3, 4] matrix, one after another
_POSITION = struct.Struct(">3f")
_INSTRUMENT = struct.Struct(">20sBB")
_INSTRUMENT_6D = 2  # both position and orientation are known
MAX_INSTRUMENTS = 32  # of one message: checking more would keep others waiting
_POSE_BYTES = {"TDATA": 48, "QTDATA": 28}  # of an instrument: a matrix, or position and quaternion
_IMAGE = struct.Struct(">HBBBB3H48s6H")
_IMAGE_VERSION, _SCALAR, _UINT8, _LITTLE_ENDIAN, _RAS = 1, 1, 3, 2, 1
_VIDEO = struct.Struct(">HB4sHB3H48s6H")
_VIDEO_VERSION = 1
_KEY, _FROM_OTHERS = 0x0100, 0x0300  # types of VIDEO frames; both tell that their luminance is grey
_STATUS = struct.Struct(">Hq20s")
_INTERVAL = struct.Struct(">I")
_CODEC_BYTES = 4


@dataclass(frozen=True, eq=False)
class Instrument:
    """A tracked instrument; `pose` [4, 4] is instrument→tracker in mm, exact."""

    name: str
    pose: FloatArray


@dataclass(frozen=True, eq=False)
class Image:
    """A slice: `pixels` uint8 [J, I]; `matrix` [4, 4] takes the centre of pixel (i, j, k = 0, 1) to mm."""

    pixels: npt.NDArray[np.uint8]
    matrix: FloatArray


@dataclass(frozen=True, eq=False)
class VideoFrame:
    """An encoded slice: `size` I, J; `matrix` [4, 4] as that of an `Image`; the first frame of a stream is a key."""

    codec: str  # of the protocol's list, such as VP90
    data: bytes
    is_key: bool
    size: tuple[int, int]
    matrix: FloatArray


@dataclass(frozen=True)
class Status:
    """A state. `code` is of the protocol's list (1: OK), `sub_code` is ours (the HTTP status of the same error)."""

    code: int
    sub_code: int
    name: str
    text: str


def unpack_transform(content: bytes) -> FloatArray:  # [4, 4] mm
    _check_size("TRANSFORM", content, _MATRIX.itemsize)
    return _rigid(content, "TRANSFORM")


def unpack_matrix(content: bytes) -> FloatArray:  # [4, 4]
    """The matrix of a TRANSFORM as it is: PLUS sends calibrations of pixels so, which are not rigid."""
    _check_size("TRANSFORM", content, _MATRIX.itemsize)
    return _matrix(content)


def pack_transform(pose: FloatArray) -> bytes:  # [4, 4]
    return pose[:3].T.astype(">f4").tobytes()


def unpack_position(content: bytes) -> FloatArray:  # [4, 4] mm
    """The pose of a POSITION, in any of its three forms: position only, with the vector part of the quaternion, with
    all of it (x, y, z, w). Raises IgtlMessageInvalid and InvalidPose.
    """
    _check_size("POSITION", content, 12, 24, 28)
    return _placed(content, "POSITION")


def pack_position(pose: FloatArray) -> bytes:  # [4, 4]
    w, x, y, z = quaternion_from_pose(pose)
    return struct.pack(">7f", *pose[:3, 3], x, y, z, w)


def unpack_instruments(
    type_name: str, content: bytes, may_be_unseen: Callable[[str], bool] = lambda name: False
) -> list[Instrument]:
    """The instruments of a TDATA or QTDATA, at most MAX_INSTRUMENTS, that have both position and orientation.

    Those of a name that `may_be_unseen` are left out where their pose is zeros or NaN: trackers send that for what
    they lost. Raises IgtlMessageInvalid and, naming the instrument, InvalidPose.
    """
    size = _INSTRUMENT.size + _POSE_BYTES[type_name]
    if len(content) % size:
        raise IgtlMessageInvalid(
            f"{type_name} must hold {size} bytes for each instrument, got {len(content)} bytes", field="body"
        )
    if len(content) > MAX_INSTRUMENTS * size:
        raise IgtlMessageInvalid(
            f"{type_name} may hold at most {MAX_INSTRUMENTS} instruments, got {len(content) // size}", field="body"
        )
    unpack = _rigid if type_name == "TDATA" else _placed
    instruments = []
    for start in range(0, len(content), size):
        name, kind, _ = _INSTRUMENT.unpack_from(content, start)
        if kind == _INSTRUMENT_6D:
            text = unpack_text(name)
            try:
                pose = unpack(content[start + _INSTRUMENT.size : start + size], f"{type_name} of {text!r}")
            except InvalidPose:
                if not may_be_unseen(text):
                    raise
            else:
                instruments.append(Instrument(text, pose))
    return instruments


def pack_instruments(type_name: str, instruments: Iterable[Instrument]) -> bytes:
    pack = pack_transform if type_name == "TDATA" else pack_position
    return b"".join(
        _INSTRUMENT.pack(pack_text(one.name, DEVICE_NAME_BYTES), _INSTRUMENT_6D, 0) + pack(one.pose)
        for one in instruments
    )


def unpack_image(content: bytes) -> Image:
    if len(content) < _IMAGE.size:
        raise IgtlMessageInvalid(f"IMAGE must hold {_IMAGE.size} bytes or more, got {len(content)}", field="body")
    version, components, scalar, _, _, columns, rows, slices, vectors, *part = _IMAGE.unpack_from(content)
    whole = [0, 0, 0, columns, rows, slices]
    if (version, components, scalar, slices, part) != (_IMAGE_VERSION, _SCALAR, _UINT8, 1, whole):
        raise IgtlMessageInvalid("IMAGE must be one whole slice of one 8-bit component", field="body")
    _check_size("IMAGE", content, _IMAGE.size + rows * columns)
    pixels = np.frombuffer(content, np.uint8, offset=_IMAGE.size).reshape(rows, columns)
    matrix = np.eye(4)
    matrix[:3] = np.frombuffer(vectors, ">f4").reshape(4, 3).T
    matrix[:3, 3] -= matrix[:3, :2] @ ((columns - 1) / 2, (rows - 1) / 2)
    return Image(pixels, matrix)


def pack_image(image: Image) -> bytes:
    """The content of an IMAGE."""
    rows, columns = image.pixels.shape
    size = (columns, rows, 1)
    kind = (_IMAGE_VERSION, _SCALAR, _UINT8, _LITTLE_ENDIAN, _RAS)
    part = (0, 0, 0, *size)  # the whole image
    return _IMAGE.pack(*kind, *size, _pack_place(image.matrix, columns, rows), *part) + image.pixels.tobytes()


def pack_video(frame: VideoFrame) -> bytes:
    """The content of a VIDEO."""
    size = (*frame.size, 1)
    kind = (_LITTLE_ENDIAN, frame.codec.encode(), _KEY if frame.is_key else _FROM_OTHERS, _RAS)
    part = (0, 0, 0, *size)
    return _VIDEO.pack(_VIDEO_VERSION, *kind, *size, _pack_place(frame.matrix, *frame.size), *part) + frame.data


def _pack_place(matrix: FloatArray, columns: int, rows: int) -> bytes:
    """The matrix of an image; the protocol gives the position of the image's centre, not of its first pixel."""
    vectors = matrix[:3].copy()
    vectors[:, 3] += vectors[:, :2] @ ((columns - 1) / 2, (rows - 1) / 2)
    return vectors.T.astype(">f4").tobytes()


def unpack_status(content: bytes) -> Status:
    if len(content) < _STATUS.size:
        raise IgtlMessageInvalid(f"STATUS must hold {_STATUS.size} bytes or more, got {len(content)}", field="body")
    code, sub_code, name = _STATUS.unpack_from(content)
    return Status(code, sub_code, unpack_text(name), unpack_text(content[_STATUS.size :]))


def pack_status(status: Status) -> bytes:
    return _STATUS.pack(status.code, status.sub_code, pack_text(status.name, 19)) + status.text.encode() + b"\0"


def pack_capability(type_names: Iterable[str]) -> bytes:
    return b"".join(name.encode().ljust(TYPE_NAME_BYTES, b"\0") for name in type_names)


def unpack_video_query(content: bytes) -> tuple[str, float]:
    """Codec ("": not named) and least time between two messages, s, of an STT_VIDEO. Raises IgtlMessageInvalid."""
    return unpack_text(content[:_CODEC_BYTES]), unpack_interval_s(content[_CODEC_BYTES:])


def unpack_interval_s(content: bytes) -> float:
    """The least time between two messages of a subscription; not given: 0. Raises IgtlMessageInvalid."""
    if not content:
        return 0.0
    if len(content) < _INTERVAL.size:
        raise IgtlMessageInvalid(f"an interval must hold {_INTERVAL.size} bytes, got {len(content)}", field="body")
    return float(_INTERVAL.unpack_from(content)[0]) / 1000.0


def _check_size(type_name: str, content: bytes, *sizes: int) -> None:
    if len(content) not in sizes:
        expected = " or ".join(str(size) for size in sizes)
        raise IgtlMessageInvalid(f"{type_name} must hold {expected} bytes, got {len(content)}", field="body")


def _rigid(values: bytes, what: str) -> FloatArray:
    exact: FloatArray = check_poses(_matrix(values), field=what)[0]
    return exact


def _matrix(values: bytes) -> FloatArray:  # [4, 4]
    matrix = np.eye(4)
    matrix[:3] = np.frombuffer(values, ">f4").reshape(4, 3).T
    return matrix


def _placed(values: bytes, what: str) -> FloatArray:
    position = _POSITION.unpack_from(values)
    x, y, z = _POSITION.unpack_from(values, _POSITION.size) if len(values) > _POSITION.size else (0.0, 0.0, 0.0)
    if len(values) > 2 * _POSITION.size:
        (w,) = struct.unpack_from(">f", values, 2 * _POSITION.size)
    else:
        w = math.sqrt(max(0.0, 1.0 - x * x - y * y - z * z))
    return pose_from_position_quaternion(position, (w, x, y, z), field=what)


OK, UNKNOWN_ERROR, NOT_FOUND, ACCESS_DENIED, BUSY, TIMED_OUT = 1, 2, 4, 5, 6, 7
CHECKSUM_ERROR, CONFIGURATION_ERROR, NO_RESOURCES, UNKNOWN_INSTRUCTION, NOT_READY, SHUTTING_DOWN = 9, 10, 11, 12, 13, 19

_CODES = {  # by the HTTP statuses of the same errors
    **{400: UNKNOWN_INSTRUCTION, 401: ACCESS_DENIED, 403: ACCESS_DENIED, 404: NOT_FOUND, 422: CONFIGURATION_ERROR},
    **{429: BUSY, 501: UNKNOWN_INSTRUCTION, 503: NOT_READY, 504: TIMED_OUT, 507: NO_RESOURCES},
}
_EXCEPTIONS = {TooManyConnections.reason: BUSY, Draining.reason: SHUTTING_DOWN}


def state_of(error: UltragrayError) -> Status:
    """The state that tells an error: code of the list, HTTP status as sub-code, reason as name, detail as text."""
    http = statuses_of(error).http
    code = _EXCEPTIONS.get(error.reason) or _CODES.get(http, UNKNOWN_ERROR)
    if isinstance(error, IgtlMessageInvalid) and error.field == "crc":
        code = CHECKSUM_ERROR
    return Status(code, http, error.reason, error.detail)
