"""How far frames extrapolate from what their scene was trained on."""

from __future__ import annotations

from dataclasses import dataclass, fields

from ultragray_proto.v1 import rendering_pb2, scenes_pb2

from .errors import InvalidArgument

_BELOW = {"refuse": rendering_pb2.BELOW_CONFIDENCE_REFUSE, "mask": rendering_pb2.BELOW_CONFIDENCE_MASK}


@dataclass(frozen=True)
class Extrapolation:
    """How far a frame extrapolates; None is what the scene cannot tell."""

    distance_mm: float | None  # to the nearest training views, a mean over the image
    angle_deg: float | None  # likewise
    confidence: float | None  # the MS-SSIM, 0 to 1, that a real frame is expected to have with this one
    supported_share: float | None  # of the pixels, by Gaussians


@dataclass(frozen=True)
class ConfidenceFit:
    """How well a scene knows the confidence of its frames."""

    error: float  # mean absolute error of the confidence on the views that it was fitted on
    fitted_on: int  # how many those are


def confidence_fit_from_message(message: scenes_pb2.ConfidenceFit) -> ConfidenceFit:
    """What the service tells of a scene."""
    return ConfidenceFit(error=message.error, fitted_on=message.fitted_on)


def extrapolation_from_message(message: rendering_pb2.Extrapolation) -> Extrapolation:
    """What the service tells of a frame."""
    names = [field.name for field in fields(Extrapolation)]
    return Extrapolation(**{name: getattr(message, name) if message.HasField(name) else None for name in names})


def below_confidence_number(name: str) -> rendering_pb2.BelowConfidence:
    """The number of "refuse" or "mask". Raises InvalidArgument for another word."""
    if name not in _BELOW:
        field = "below_min_confidence"
        raise InvalidArgument(f"{field} must be one of {', '.join(_BELOW)}, got {name!r}", field=field)
    return _BELOW[name]
