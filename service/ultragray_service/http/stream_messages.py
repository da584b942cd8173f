"""Messages of the service over a WebSocket."""

from __future__ import annotations

from dataclasses import dataclass

from ultragray.contract import described
from ultragray.errors import UltragrayError
from ultragray.rendering.settings import settings_used
from ultragray_service.core.frames import FrameHeader
from ultragray_service.core.open_streams import Answered
from ultragray_service.errors import Refusal
from ultragray_service.http.bodies import adapter_of

_ALIGNMENT = 8  # so that a client may look at float32 pixels where they lie


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What every message of the service begins with."""

    sequence: int = described("Of the message that it answers.")
    client_time_ms: float | None = described("Likewise.")
    dropped: int = described("Poses that newer ones replaced since the answer before.")


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameMessage(FrameHeader, Answer):
    """The JSON before the pixels of a frame."""


@dataclass(frozen=True, kw_only=True)
class RefusalMessage(Answer):
    """The text message in place of a frame."""

    error: Refusal


def frame_bytes(answered: Answered) -> bytes:
    """A frame as one binary message: the length of the JSON that follows (uint32, little endian), the JSON, the data.

    Spaces at the end of the JSON let the data begin at a multiple of 8 bytes.
    """
    assert not isinstance(answered.outcome, UltragrayError)
    header: bytes = adapter_of(FrameMessage).dump_json(
        FrameMessage.of(
            answered.outcome,
            **vars(settings_used(answered.outcome.settings)),
            sequence=answered.sequence,
            client_time_ms=answered.client_time,
            dropped=answered.dropped,
        )
    )
    header += b" " * (-(4 + len(header)) % _ALIGNMENT)
    return len(header).to_bytes(4, "little") + header + answered.outcome.data


def refusal_text(answered: Answered) -> str:
    """The text message in place of a frame."""
    assert isinstance(answered.outcome, UltragrayError)
    message = RefusalMessage(
        sequence=answered.sequence,
        client_time_ms=answered.client_time,
        dropped=answered.dropped,
        error=Refusal.of(answered.outcome),
    )
    text: bytes = adapter_of(RefusalMessage).dump_json(message)
    return text.decode()
