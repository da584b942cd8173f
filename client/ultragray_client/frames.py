"""Frames: what they are asked with, and what comes."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from ultragray_proto.v1 import rendering_pb2

from .confidence import Extrapolation, below_confidence_number, extrapolation_from_message
from .display import Display, Picture, display_from_message, display_message, picture_from_message
from .errors import InvalidArgument, UnknownOutput
from .geometry import FloatArray, Probe, matrix_from_message, probe_from_message, probe_message

_OUTPUT_PREFIX = "OUTPUT_"
_ENCODINGS = {"uint8": rendering_pb2.ENCODING_UINT8, "float32": rendering_pb2.ENCODING_FLOAT32}
_DTYPES: dict[int, np.dtype[Any]] = {
    rendering_pb2.ENCODING_UINT8: np.dtype("u1"),
    rendering_pb2.ENCODING_FLOAT32: np.dtype("<f4"),
}


@dataclass(frozen=True)
class Timings:
    """What a frame cost in the service, milliseconds."""

    queue_ms: float  # from the arrival of the request to the start of its rendering
    render_ms: float  # of the batch that it was rendered in
    encode_ms: float


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame, and all that is needed to render it again. `frame["bmode"]` is one of its arrays."""

    arrays: Mapping[str, npt.NDArray[Any]]  # by output, each [H, W], read-only: uint8 of 0 to 255, or float32 of 0 to 1
    pose: FloatArray  # [4, 4] mm, as used
    probe: Probe
    scene: str
    scene_sha256: str  # of the scene file
    renderer: str  # name, version and backend
    sequence: int  # in a batch from 0; in a stream that of its pose, from 1
    timings: Timings
    extrapolation: Extrapolation
    picture: Picture  # where the pixels lie
    rendered_height: int  # depth samples, before `display` was applied
    rendered_width: int  # scan lines, likewise
    display: Display | None = None  # as used; None: none was asked for
    dropped: int = 0  # in a stream: poses that newer ones replaced since the frame before
    latency_ms: float | None = None  # in a stream: from `measured_ns` of the pose to the arrival of the frame here

    def __getitem__(self, output: str) -> npt.NDArray[Any]:  # [H, W]
        return self.arrays[output]

    def pixel_to_scene(self) -> FloatArray:  # [4, 4]
        """Takes (column, row, k, 1) to mm in the scene's frame: the centre of pixel [row, column] where k is 0.

        k: mm out of the image plane, against the probe's elevation y. The inverse tells which pixel shows a point, and
        how far from the plane it lies. Raises InvalidArgument where columns are angles: ask for the frame of a fan
        with `display=Display(pixel_mm=...)`.
        """
        return self.pose @ self.picture.pixel_to_probe()


def settings_message(
    scene: str,
    *,
    outputs: Sequence[str],
    dtype: str,
    height: int | None,
    width: int | None,
    probe: Probe | None,
    display: Display | None,
    min_confidence: float | None,
    below_min_confidence: str,
) -> rendering_pb2.RenderSettings:
    """Raises UnknownOutput, and InvalidArgument for a word that is none; the service checks the rest."""
    if dtype not in _ENCODINGS:
        raise InvalidArgument(f"dtype must be one of {', '.join(_ENCODINGS)}, got {dtype!r}", field="dtype")
    return rendering_pb2.RenderSettings(
        scene=scene,
        height=height,
        width=width,
        outputs=output_numbers(outputs),
        encoding=_ENCODINGS[dtype],
        probe=None if probe is None else probe_message(probe),
        display=None if display is None else display_message(display),
        min_confidence=min_confidence,
        below_min_confidence=below_confidence_number(below_min_confidence),
    )


def output_numbers(outputs: Sequence[str]) -> list[Any]:
    """The numbers of outputs by name. Raises UnknownOutput."""
    known = {
        name.removeprefix(_OUTPUT_PREFIX).lower(): number for name, number in rendering_pb2.Output.items() if number
    }
    names = (outputs,) if isinstance(outputs, str) else tuple(outputs)
    for name in names:
        if name not in known:
            raise UnknownOutput(f"outputs must be some of {', '.join(known)}, got {name!r}", field="outputs")
    return [known[name] for name in names]


def output_names(numbers: Sequence[Any]) -> tuple[str, ...]:
    """The names of outputs that the service tells."""
    return tuple(rendering_pb2.Output.Name(number).removeprefix(_OUTPUT_PREFIX).lower() for number in numbers)


def frame_from_message(message: rendering_pb2.Frame, *, sequence: int, dropped: int = 0) -> Frame:
    """The frame; its arrays are views of one buffer."""
    dtype = _DTYPES[message.encoding]
    pixels = np.frombuffer(message.data, dtype).reshape(-1, message.height, message.width)
    probe = probe_from_message(message.probe)
    assert probe is not None
    timings = message.timings
    sent_ns = message.client_time_ns if message.HasField("client_time_ns") else None
    return Frame(
        arrays=MappingProxyType(dict(zip(output_names(message.outputs), pixels, strict=True))),
        pose=matrix_from_message(message.pose),
        probe=probe,
        scene=message.scene,
        scene_sha256=message.scene_sha256,
        renderer=message.renderer,
        sequence=sequence,
        timings=Timings(timings.queue_ms, timings.render_ms, timings.encode_ms),
        extrapolation=extrapolation_from_message(message.extrapolation),
        picture=picture_from_message(message.picture),
        rendered_height=message.rendered_height,
        rendered_width=message.rendered_width,
        display=display_from_message(message.display) if message.HasField("display") else None,
        dropped=dropped,
        latency_ms=None if sent_ns is None else (time.monotonic_ns() - sent_ns) / 1e6,
    )
