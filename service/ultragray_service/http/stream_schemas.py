"""The messages of a WebSocket stream."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any, Literal

from pydantic import BaseModel, Field
from typing_extensions import TypedDict  # pydantic reads those of `typing` from Python 3.12 on

from ultragray.confidence.assess import Extrapolation
from ultragray.contract import to_dict
from ultragray.errors import UltragrayError
from ultragray.probe import Picture
from ultragray_workers.pool.types import RenderResult

from ..core.pose_stream import Answered, StreamMode
from .schemas import DisplayBody, MatrixRows, OutputName, PoseBody, ProbeBody, RequestModel

_ALIGNMENT = 8  # so that a client may look at float32 pixels where they lie


class StreamSettings(RequestModel):
    """What to render, but for the pose. What is left out is as the scene has it."""

    height: int | None = None
    width: int | None = None
    probe: ProbeBody | None = None
    min_confidence: float | None = None
    below_min_confidence: Literal["refuse", "mask"] = "refuse"
    display: DisplayBody | None = None
    outputs: list[str] = Field(default=["bmode"])
    encoding: Literal["uint8", "float32", "png", "jpeg"] = "uint8"


class StreamMessage(RequestModel):
    """One message of the client."""

    sequence: int = Field(0, ge=0, le=2**64 - 1, description="Any number; the answer to this message carries it.")
    settings: StreamSettings | None = Field(None, description="Replaces all settings, from this pose on.")
    pose: PoseBody | None = None
    mode: Literal["ordered", "latest"] | None = Field(None, description="Of the stream; read from its first message.")
    timeout_ms: float | None = Field(None, gt=0, le=3_600_000, description="Later this pose is not rendered.")
    client_time_ms: float | None = Field(None, description="Any number; the answer carries it.")

    def stream_mode(self) -> StreamMode:
        """The mode asked for."""
        return StreamMode(self.mode or StreamMode.ORDERED)


class PictureOut(TypedDict):
    """Where the pixels of a frame lie: `first` is the centre of pixel (0, 0), `step` the way to the next one.

    Column and row: x and z in mm, or, where the columns are degrees, the angle from the z axis and the range in mm.
    """

    column_unit: Literal["mm", "deg"]
    first: tuple[float, float]
    step: tuple[float, float]


class Answer(TypedDict):
    """What every message of the service begins with."""

    sequence: int
    client_time_ms: float | None
    dropped: int


class FrameHeader(Answer):
    """The JSON before the pixels of a frame."""

    scene: str
    scene_sha256: str
    renderer: str
    pose: MatrixRows
    probe: ProbeBody
    rendered_height: int
    rendered_width: int
    display: DisplayBody
    height: int
    width: int
    picture: PictureOut
    outputs: list[OutputName]
    encoding: str
    extrapolation: Extrapolation
    queue_ms: float
    render_ms: float
    encode_ms: float


class Refusal(TypedDict):
    """Why a pose has no frame."""

    reason: str
    detail: str
    field: str | None


class RefusalMessage(Answer):
    """The text message in place of a frame."""

    error: Refusal


def message_numbers(text: str) -> tuple[int, float | None]:
    """Sequence and client time of a message that cannot be used otherwise, as far as they can be read."""
    try:
        document = json.loads(text)
        numbered = _Numbers.model_validate(document if isinstance(document, dict) else {})
    except (ValueError, RecursionError):
        return 0, None
    return numbered.sequence, numbered.client_time_ms


class _Numbers(BaseModel):
    sequence: int = Field(0, ge=0, le=2**64 - 1)
    client_time_ms: float | None = Field(None, allow_inf_nan=False)


def picture_json(picture: Picture) -> dict[str, Any]:
    """Where the pixels of a frame lie."""
    return {"column_unit": picture.column_unit, "first": picture.first, "step": picture.step}


def frame_bytes(answered: Answered, result: RenderResult) -> bytes:
    """A frame as one binary message: the length of the JSON that follows (uint32, little endian), the JSON, the data.

    Spaces at the end of the JSON let the data begin at a multiple of 8 bytes.
    """
    about = {
        **_about(answered),
        "scene": result.scene,
        "scene_sha256": result.scene_sha256,
        "renderer": result.renderer,
        "pose": result.poses[0].tolist(),
        "probe": to_dict(result.settings.probe),
        "rendered_height": result.settings.height,
        "rendered_width": result.settings.width,
        "display": asdict(result.settings.display),
        "height": result.height,
        "width": result.width,
        "picture": picture_json(result.settings.picture),
        "outputs": result.settings.outputs,
        "encoding": result.settings.encoding.value,
        "extrapolation": asdict(result.extrapolations[0]),
        "queue_ms": round(result.queue_ms, 3),
        "render_ms": round(result.render_ms, 3),
        "encode_ms": round(result.encode_ms, 3),
    }
    header = json.dumps(about).encode()
    header += b" " * (-(4 + len(header)) % _ALIGNMENT)
    return len(header).to_bytes(4, "little") + header + result.data


def error_text(answered: Answered, error: UltragrayError) -> str:
    """The text message in place of a frame."""
    return json.dumps(
        {**_about(answered), "error": {"reason": error.reason, "detail": error.detail, "field": error.field}}
    )


def _about(answered: Answered) -> dict[str, Any]:
    return {"sequence": answered.sequence, "client_time_ms": answered.client_time, "dropped": answered.dropped}
