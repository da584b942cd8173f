"""Frames, from the settings of a request to the arrays of its answer."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from dataclasses import field as field_of
from enum import Enum
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from ultragray_client.contract import (
    Additions,
    ClockOffset,
    Encoding,
    Extrapolation,
    Prediction,
    Preview,
    RenderSettings,
    SettingsUsed,
)
from ultragray_client.errors import InvalidArgument
from ultragray_client.geometry import FloatArray, PoseLike, pose_message
from ultragray_client.messages import FrameHeads, ReceivedFrame, message_of
from ultragray_proto.codec import from_message, words
from ultragray_proto.v1 import recordings_pb2, rendering_pb2

_PIXEL_TYPES: dict[str, np.dtype[Any]] = {
    Encoding.UINT8: np.dtype("u1"),
    Encoding.FLOAT32: np.dtype("<f4"),
    Encoding.FLOAT16: np.dtype("<f2"),
}
_ENCODINGS = words(rendering_pb2.Encoding.DESCRIPTOR)


@dataclass(frozen=True)
class Timings:
    """Costs of a frame in the service, milliseconds."""

    queue_ms: float  # from the arrival of the request to the start of its rendering
    render_ms: float  # of the batch that it was rendered in
    encode_ms: float


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameOrigin(SettingsUsed):
    """What all frames of a stream have in common."""

    scene: str
    scene_sha256: str  # of the scene file
    renderer: str  # name, version and backend


@dataclass(frozen=True, eq=False, kw_only=True)
class Frame(FrameOrigin):
    """A frame, and all that is needed to render it again. `frame["bmode"]` is one of its arrays."""

    arrays: Mapping[str, npt.NDArray[Any]]  # by output, each [H, W], read-only: uint8 of 0 to 255, or floats of 0 to 1
    pose: FloatArray  # [4, 4] mm, as used
    sequence: int  # in a batch from 0; in a stream that of its pose, from 1
    timings: Timings
    extrapolation: Extrapolation
    dropped: int = 0  # in a stream: poses that newer ones replaced since the frame before
    latency_ms: float | None = None  # in a stream: from `measured_ns` of the pose to the arrival of the frame here
    prediction: Prediction | None = None  # in a stream: how `pose` was foretold; None: it is as it was sent
    preview: Preview | None = None  # in a stream: how real frames corrected it; None: none did
    clock: ClockOffset | None = None  # in a stream: time.monotonic() here beside the service's; None: not known yet

    def __repr__(self) -> str:
        x, y, z = self.pose[:3, 3]
        pictures = ", ".join(f"{name} {'x'.join(map(str, pixels.shape))}" for name, pixels in self.arrays.items())
        return f"Frame({self.scene!r}, {pictures}, at ({x:.4g}, {y:.4g}, {z:.4g}) mm)"

    def __getitem__(self, output: str) -> npt.NDArray[Any]:  # [H, W]
        return self.arrays[output]

    def pixel_to_scene(self) -> FloatArray:  # [4, 4]
        """Takes (column, row, k, 1) to mm in the scene's frame: the centre of pixel [row, column] where k is 0.

        k: mm out of the image plane, against the probe's elevation y. The inverse tells which pixel shows a point, and
        how far from the plane it lies. Raises InvalidArgument where columns are angles: ask for the frame of a fan
        with `Display(pixel_mm=...)`.
        """
        return self.pose @ self.picture.pixel_to_probe()


def origin_of(frame: Frame) -> dict[str, Any]:
    """The origin of a frame and its settings as used, as JSON holds them; as the files of jobs have it."""
    origin: dict[str, Any] = {name: getattr(frame, name) for name in ("scene", "scene_sha256", "renderer")}
    plain = {one.name: one.default for one in fields(Additions)}  # as they are where they were not asked for
    for one in fields(SettingsUsed):
        value = getattr(frame, one.name)
        if one.name not in plain or value != plain[one.name]:
            origin[one.name] = _plain(value)
    picture = frame.picture
    origin["picture"] = {
        "height": frame.height,
        "width": frame.width,
        "column_unit": picture.column_unit,
        "first": (picture.first_column, picture.first_row_mm),
        "step": (picture.column_step, picture.row_step_mm),
    }
    return origin


def _plain(value: Any) -> Any:
    """A value of the contract as JSON holds it."""
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, tuple):
        return [_plain(one) for one in value]
    return {one.name: _plain(getattr(value, one.name)) for one in fields(value)} if is_dataclass(value) else value


@dataclass(frozen=True, eq=False)
class Slice:
    """A field of a scene on a plane. `slice.pixels[row, column]` is one of its values."""

    pixels: npt.NDArray[Any] = field_of(repr=False)  # [H, W], read-only: float32, of labels uint8
    field: str
    pixel_to_scene: FloatArray  # [4, 4]: takes (column, row, k, 1), counted from 0 at pixels' centres, to mm
    scene: str
    scene_sha256: str  # of the scene file
    timings: Timings


def slice_from_message(message: rendering_pb2.Slice) -> Slice:
    """The slice; its pixels are a read-only view of the message's own."""
    pixels = np.frombuffer(message.data, _PIXEL_TYPES[_ENCODINGS[message.encoding]])
    return from_message(message, Slice, pixels=pixels.reshape(message.height, message.width))


def settings_message(scene: str, settings: RenderSettings | None) -> rendering_pb2.RenderSettings:
    """The settings of a scene; None: the defaults. Raises UnknownOutput, and InvalidArgument for another word."""
    settings = settings or RenderSettings()
    if settings.encoding not in _PIXEL_TYPES:
        names = " or ".join(Encoding(known).value for known in _PIXEL_TYPES)
        raise InvalidArgument(
            f"encoding must be {names}, whose pixels come as arrays, got {settings.encoding!r}", field="encoding"
        )
    return message_of(settings, rendering_pb2.RenderSettings, scene=scene)


_HEADS = FrameHeads(FrameOrigin)


def received_frame(raw: bytes) -> ReceivedFrame:
    """The frame of its bytes. Raises google.protobuf.message.DecodeError."""
    return _HEADS.read(raw)


def frame_from_message(received: ReceivedFrame, *, sequence: int = 0, dropped: int = 0, data: Any = None) -> Frame:
    """The frame; its arrays are read-only views of the buffer `data`; None: of the message's own."""
    message, same = received.message, received.same
    if not same:
        same = vars(from_message(message, FrameOrigin))
    pixels = np.frombuffer(received.data if data is None else data, _PIXEL_TYPES[same["encoding"]])
    pixels.setflags(write=False)
    pixels = pixels.reshape(-1, same["height"], same["width"])
    has = message.HasField
    return from_message(
        message,
        Frame,
        **same,
        arrays=MappingProxyType(dict(zip(same["outputs"], pixels, strict=True))),
        sequence=sequence,
        dropped=dropped,
        latency_ms=(time.monotonic_ns() - message.client_time_ns) / 1e6 if has("client_time_ns") else None,
        prediction=from_message(message.prediction, Prediction) if has("prediction") else None,
        preview=from_message(message.preview, Preview) if has("preview") else None,
        clock=from_message(message.clock, ClockOffset) if has("clock") else None,
    )


# Real frames looked for in scenes, from the arrays of a caller to what the service found.


@dataclass(frozen=True, eq=False)
class Localization:
    """Where a real frame was taken, and how certain that is. The standard deviations hold where `is_found` does."""

    pose: FloatArray  # [4, 4] mm, probe to scene; not to be used where it is not found
    flange_to_base: FloatArray | None  # [4, 4] mm, the same as the pose of the registration; None: none was named
    registration: str | None  # that led the start into the scene
    similarity: float  # correlation of the structures of the frame and of the scene there, -1 to 1
    is_found: bool  # whether that is as high as only the right place has it
    position_std_mm: tuple[float, float, float]  # along the probe's lateral, elevation and axial axis
    angle_std_deg: tuple[float, float, float]  # about them, through the middle of the image
    shift_mm: float  # of the middle of the image, from the start
    turn_deg: float
    scene: str
    scene_sha256: str  # of the scene file
    renderer: str  # name, version and backend
    queue_ms: float
    search_ms: float


@dataclass(frozen=True, eq=False)
class PlannedView:
    """A view of a plan."""

    pose: FloatArray  # [4, 4] mm, probe to scene
    flange_to_base: FloatArray | None  # [4, 4] mm, the same as the pose of the registration; None: none was named
    gain: float  # what it is expected to add to what is wanted, beside the views of lower ranks
    rank: int  # 0: it was chosen first, as it gains most


@dataclass(frozen=True, eq=False)
class ViewPlan:
    """Where to look next. `before` and `after` are shares, 0 to 1, of confidence an MS-SSIM."""

    views: tuple[PlannedView, ...]  # in an order to travel them; fewer than asked for where no other gains anything
    before: float  # what is wanted, as the scene has it
    after: float  # and as it is expected to be with the views
    path_mm: float  # of the way through the views, from the start where one was given
    registration: str | None  # that led the poses into the scene
    scene: str
    scene_sha256: str  # of the scene file
    queue_ms: float
    plan_ms: float


@dataclass(frozen=True, eq=False)
class RealFrame:
    """A frame as a probe took it: rows along depth, columns across scan lines, not scan-converted."""

    image: npt.ArrayLike | bytes  # grey values [H, W], uint8 or in [0, 1], or the bytes of a PNG file
    pose: PoseLike  # of the probe, in the frame of the tracker
    time_s: float | None = None  # when it was taken
    number: int | None = None  # in the caller's count, which grows; one that is missing is a lost frame. None: the next

    def message(self) -> recordings_pb2.IncomingFrame:
        """The message of the frame. Raises InvalidArgument for what is no grey image, and InvalidPose."""
        image = self.image if isinstance(self.image, bytes) else grey_pixels(self.image).tobytes()
        return recordings_pb2.IncomingFrame(
            number=self.number, pose=pose_message(self.pose), time_s=self.time_s, image=image
        )


def grey_pixels(image: npt.ArrayLike) -> npt.NDArray[np.uint8]:  # [H, W]
    """Grey values as uint8. Raises InvalidArgument for what is no grey image."""
    pixels = np.asarray(image)
    if pixels.ndim != 2 or (pixels.dtype != np.uint8 and pixels.dtype.kind != "f"):
        raise InvalidArgument(
            "image must be the bytes of a PNG file or grey values [H, W], uint8 or floating point, "
            f"got {pixels.dtype} {list(pixels.shape)}",
            field="image",
        )
    if pixels.dtype != np.uint8:
        if not (np.isfinite(pixels).all() and pixels.min(initial=0.0) >= 0.0 and pixels.max(initial=0.0) <= 1.0):
            raise InvalidArgument("image of floating point must hold finite values in [0, 1]", field="image")
        pixels = np.rint(255.0 * pixels).astype(np.uint8)
    return pixels


def image_fields(image: npt.ArrayLike | bytes) -> dict[str, Any]:
    """The fields of a request that hold a real frame. Raises InvalidArgument for what is no grey image."""
    if isinstance(image, bytes):
        return {"image": image}
    pixels = grey_pixels(image)
    return {"image": pixels.tobytes(), "image_height": pixels.shape[0], "image_width": pixels.shape[1]}
