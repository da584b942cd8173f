"""Settings of frames, as every door takes them beside the scene and the poses: content, display and encoding.

A request's settings are checked and completed once, by `resolved`; what comes after trusts the result. Free of torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import Any

import numpy as np

from ultragray.contract import Contract, described
from ultragray.errors import InvalidArgument, InvalidImageSize, InvalidProbe, UnknownOutput
from ultragray.geometry.image_size import MAX_IMAGE_SIDE, check_image_size
from ultragray.geometry.probe import MAX_THICKNESS_MM, PLANE, ElevationBeam, Picture, Probe
from ultragray.rendering.display import AS_RENDERED, Display
from ultragray.rendering.outputs import OUTPUTS, check_available, check_outputs
from ultragray.rendering.tools import MAX_TOOLS, Tool
from ultragray.scene.info import SceneInfo


class Encoding(str, Enum):
    """The form that pixels come in."""

    UINT8 = "uint8"
    FLOAT32 = "float32"
    PNG = "png"
    JPEG = "jpeg"
    NPZ = "npz"

    @property
    def is_image_file(self) -> bool:
        """Whether it holds exactly one frame of one output."""
        return self in (Encoding.PNG, Encoding.JPEG)

    @property
    def pixel_type(self) -> np.dtype[Any]:
        """The type that pixels are rounded to."""
        return np.dtype("<f4") if self in (Encoding.FLOAT32, Encoding.NPZ) else np.dtype("u1")


FRAME_ENCODINGS = tuple(one.value for one in Encoding if one is not Encoding.NPZ)
"""Those of one frame; npz is an archive of many."""


class Below(str, Enum):
    """The fate of a frame whose confidence is below the limit."""

    REFUSE = "refuse"
    MASK = "mask"


class Contact(str, Enum):
    """What a frame shows of the probe's contact with the skin (`ultragray.rendering.contact`)."""

    AIR = "air"
    PRESSURE = "pressure"


@dataclass(frozen=True, kw_only=True)
class FrameSettings(Contract):
    """Settings of what is rendered, but for the scene and the poses. None: as the scene has it.

    Raises InvalidProbe, InvalidImageSize, UnknownOutput, InvalidArgument.
    """

    __topic__ = "Frames"
    height: int | None = described(
        "Depth samples. Default: as trained, else 512.", None, low=1, high=MAX_IMAGE_SIDE, error=InvalidImageSize
    )
    width: int | None = described(
        "Scan lines. Default: as trained, else 512.", None, low=1, high=MAX_IMAGE_SIDE, error=InvalidImageSize
    )
    probe: Probe | None = described("Instead of the scene's own.", None, error=InvalidProbe)
    min_confidence: float | None = described(
        "What is below is refused, or masked.", None, low=0.0, high=1.0, topic="Confidence"
    )
    below_min_confidence: Below = described(
        "mask: pixels of such frames that Gaussians do not support are 0.", Below.REFUSE, topic="Confidence"
    )
    slice_thickness_mm: float | None = described(
        "Full width at half maximum along elevation at the focus of the scene's beam; 0: a plane. Default: as trained.",
        None,
        low=0.0,
        high=MAX_THICKNESS_MM,
    )
    contact: Contact | None = described(
        "air: scan lines whose face is off the skin are dark. pressure: and a face that is pressed in compresses the "
        "tissue. Default: contact is assumed.",
        None,
    )
    tools: tuple[Tool, ...] | None = described(
        "Needles and the like in the image; labels then are there for every scene.", None, most=MAX_TOOLS
    )
    ghost: float | None = described(
        "Second echo: share of what is heard beyond the first strong interface that is the mirror image of what lies "
        "before it. Default: 0.",
        None,
        low=0.0,
        high=1.0,
    )
    display: Display | None = described("Gain, depth, scan conversion ...; default: as rendered.", None)
    outputs: tuple[str, ...] = described(f"Some of {', '.join(OUTPUTS)}.", ("bmode",), error=UnknownOutput)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "outputs", check_outputs(self.outputs))

    @property
    def least_confidence(self) -> float | None:
        """The confidence without which poses are refused, or left out by a sampler; None: any."""
        return self.min_confidence if self.below_min_confidence is Below.REFUSE else None

    def resolved(self, info: SceneInfo, encoding: Encoding, *, max_image_side: int = MAX_IMAGE_SIDE) -> Resolved:
        """The settings for a scene, with nothing left open.

        Raises InvalidProbe where neither side knows a probe, InvalidImageSize beyond `max_image_side`, UnknownOutput
        for outputs that the scene cannot give, InvalidArgument for a confidence that it cannot tell and for an encoding
        that cannot hold the outputs.
        """
        check_available(self.outputs, info, with_tools=bool(self.tools))
        height, width = info.image_size_or(self.height, self.width)
        check_image_size(height, width, limit=max_image_side)
        _check_encoding(encoding, self.outputs)
        if self.min_confidence is not None and not info.confidence:
            raise InvalidArgument(
                "min_confidence needs a scene that knows the confidence of its frames; this one was trained without",
                field="min_confidence",
            )
        return Resolved(
            probe=info.probe_or(self.probe),
            beam=info.beam_or(self.slice_thickness_mm),
            height=height,
            width=width,
            outputs=self.outputs,
            encoding=encoding,
            display=self.display or AS_RENDERED,
            min_confidence=self.min_confidence,
            below_min_confidence=self.below_min_confidence,
            contact=self.contact,
            tools=self.tools or (),
            ghost=self.ghost or 0.0,
        )


def registration_field() -> Any:
    """The field that names a registration, of what poses come with."""
    return described(
        "Name of the registration by which the poses lead into the scene: they are then flange to base, or marker to "
        "tracker. Default: they are probe to scene.",
        None,
    )


@dataclass(frozen=True, kw_only=True)
class RenderSettings(FrameSettings):
    """Settings with an encoding, for doors where neither an Accept header nor a file format decides it."""

    encoding: Encoding = described("Form of the pixels.", Encoding.UINT8, choices=tuple(FRAME_ENCODINGS))
    registration: str | None = registration_field()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.encoding.value not in FRAME_ENCODINGS:
            raise InvalidArgument(
                f"encoding must be one of {', '.join(FRAME_ENCODINGS)}, got {self.encoding.value!r}", field="encoding"
            )


@dataclass(frozen=True)
class Resolved:
    """Settings of a request for one scene, checked, with nothing left open."""

    probe: Probe
    height: int  # depth samples that are rendered
    width: int  # scan lines
    outputs: tuple[str, ...] = ("bmode",)
    beam: ElevationBeam = PLANE
    encoding: Encoding = Encoding.UINT8
    display: Display = AS_RENDERED
    min_confidence: float | None = None
    below_min_confidence: Below = Below.REFUSE
    contact: Contact | None = None
    tools: tuple[Tool, ...] = ()
    ghost: float = 0.0
    registration: str | None = None  # that led the poses into the scene

    @cached_property
    def picture(self) -> Picture:
        """Size and place of what the frames are shown as. Raises InvalidImageSize for a huge one."""
        return self.display.picture(self.probe, self.height, self.width)

    @cached_property
    def view(self) -> tuple[Any, ...]:
        """All that shows but outputs and encoding: frames that agree in this can be rendered together."""
        asked = (self.display, self.min_confidence, self.below_min_confidence, self.contact)
        return (self.probe, self.beam, self.height, self.width, *asked, self.tools, self.ghost)

    @property
    def pixels(self) -> int:
        """The number of pixels rendered or shown for one pose, whichever is more, over all outputs."""
        picture = self.picture
        return max(self.height * self.width, picture.height * picture.width) * len(self.outputs)


def _check_encoding(encoding: Encoding, outputs: tuple[str, ...]) -> None:
    if encoding.is_image_file and len(outputs) != 1:
        raise InvalidArgument(
            f"encoding {encoding.value} holds exactly one output, got {len(outputs)}", field="encoding"
        )
    if encoding is Encoding.JPEG and OUTPUTS[outputs[0]].is_numbers:
        raise InvalidArgument(f"encoding jpeg would change {outputs[0]}: ask for png, or raw pixels", field="encoding")
