"""Settings of frames, as every door takes them beside the scene and the poses: content, display and encoding.

A request's settings are checked and completed once, by `resolved`; what comes after trusts the result. Free of torch.
"""

from __future__ import annotations

import json
import pickle
from dataclasses import MISSING, dataclass, fields, replace
from enum import Enum
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from ultragray.contract import Contract, described, made_of, to_dict
from ultragray.errors import InvalidArgument, InvalidImageSize, InvalidProbe, UnknownOutput
from ultragray.geometry.image_size import MAX_IMAGE_SIDE, check_image_size
from ultragray.geometry.probe import MAX_THICKNESS_MM, PLANE, ElevationBeam, Picture, Probe
from ultragray.rendering.display import AS_RENDERED, Display
from ultragray.rendering.outputs import OUTPUT_SCHEMA, OUTPUTS, check_available, check_outputs
from ultragray.rendering.tools import MAX_TOOLS, Tool
from ultragray.scene.info import SceneInfo
from ultragray.scene.modes import MAX_MODES, Breathing, Motion


class Encoding(str, Enum):
    """The form that pixels come in."""

    UINT8 = "uint8"
    FLOAT32 = "float32"
    FLOAT16 = "float16"  # half the bytes, to 3 digits
    PNG = "png"
    JPEG = "jpeg"
    NPZ = "npz"

    @property
    def is_image_file(self) -> bool:
        return self in (Encoding.PNG, Encoding.JPEG)

    @property
    def is_raw(self) -> bool:
        """Whether it is nothing but pixels, one after another."""
        return self in (Encoding.UINT8, Encoding.FLOAT32, Encoding.FLOAT16)

    @property
    def pixel_type(self) -> np.dtype[Any]:
        return _PIXEL_TYPES[self]


_PIXEL_TYPES: dict[Encoding, np.dtype[Any]] = {
    Encoding.UINT8: np.dtype("u1"),
    Encoding.FLOAT32: np.dtype("<f4"),
    Encoding.FLOAT16: np.dtype("<f2"),
    Encoding.PNG: np.dtype("u1"),
    Encoding.JPEG: np.dtype("u1"),
    Encoding.NPZ: np.dtype("<f4"),
}
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


MAX_INDENTATION_MM = 50.0


def check_indentation(indentation_mm: float | None, contact: Contact | None) -> None:
    """Raises InvalidArgument for an indentation that is asked for without pressure."""
    if indentation_mm is not None and contact is not Contact.PRESSURE:
        name = "none" if contact is None else contact.value
        raise InvalidArgument(f"indentation_mm needs contact pressure, got contact {name}", field="indentation_mm")


class Speckle(str, Enum):
    """The speckle of a frame (`ultragray.rendering.speckle`)."""

    OFF = "off"
    NATURAL = "natural"


def check_speckle(speckle: Speckle, info: SceneInfo) -> None:
    """Raises InvalidArgument for speckle of a scene that does not know it."""
    if speckle is Speckle.NATURAL and info.speckle is None:
        raise InvalidArgument(
            "speckle natural needs a scene whose training fitted the speckle of its frames; this one has none",
            field="speckle",
        )


def check_motion(phase: tuple[float, ...] | None, breathing: Breathing | None, info: SceneInfo) -> None:
    """Raises InvalidArgument for both, for either of a still scene, and for numbers that its modes do not have."""
    if phase is not None and breathing is not None:
        raise InvalidArgument("phase and breathing are given, where one chooses the other", field="breathing")
    if info.motion is None and (phase or breathing is not None):
        name = "phase" if phase else "breathing"
        raise InvalidArgument(f"{name} needs a scene with modes of motion; this one is still", field=name)
    if phase and info.motion is not None:
        info.motion.checked(phase)


def _least_confidence(settings: FrameSettings | Additions) -> float | None:
    """The confidence without which frames are refused, or left out by a sampler; None: any."""
    return settings.min_confidence if settings.below_min_confidence is Below.REFUSE else None


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
        "air: scan lines whose face is off the skin are dark. pressure: and tissue gives way to a face that is pressed "
        "in, and to needles. Default: contact is assumed.",
        None,
    )
    indentation_mm: float | None = described(
        "How far the face is pressed in, with contact pressure. Default: as far as it lies beyond the skin of the "
        "training views.",
        None,
        low=0.0,
        high=MAX_INDENTATION_MM,
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
    phase: tuple[float, ...] | None = described(
        "Numbers of the scene's modes of motion, one each. Default: tissue is at rest.", None, most=MAX_MODES
    )
    breathing: Breathing | None = described(
        "The first mode breathes by the service's clock; frames tell the phase that they were drawn with.", None
    )
    speckle: Speckle = described(
        "natural: bmode has the speckle that scatterers in the tissue give a scanner's frames. Other outputs are as "
        "without.",
        Speckle.OFF,
    )
    display: Display | None = described("Gain, depth, scan conversion ...; default: as rendered.", None)
    outputs: tuple[str, ...] = described(f"Some of {', '.join(OUTPUTS)}.", ("bmode",), error=UnknownOutput)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "outputs", check_outputs(self.outputs))
        check_indentation(self.indentation_mm, self.contact)

    least_confidence = property(_least_confidence)

    def resolved(self, info: SceneInfo, encoding: Encoding, *, max_image_side: int = MAX_IMAGE_SIDE) -> Resolved:
        """The settings for a scene, with nothing left open.

        Raises InvalidProbe where neither side knows a probe, InvalidImageSize beyond `max_image_side`, UnknownOutput
        for outputs that the scene cannot give, InvalidArgument for a confidence that it cannot tell, for speckle that
        it does not know, and for an encoding that cannot hold the outputs.
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
        check_speckle(self.speckle, info)
        check_motion(self.phase, self.breathing, info)
        additions = {one.name: getattr(self, one.name, None) for one in fields(Additions)}
        return Resolved(
            probe=info.probe_or(self.probe),
            beam=info.beam_or(self.slice_thickness_mm),
            height=height,
            width=width,
            outputs=self.outputs,
            encoding=encoding,
            display=self.display or AS_RENDERED,
            breathing=self.breathing,
            **{name: value for name, value in additions.items() if value is not None},
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


@dataclass(frozen=True, kw_only=True)
class Additions:
    """What a frame has only where it was asked for, as it was used."""

    # A setting of frames that has a default of its own is a field here, of the name that it has in `FrameSettings`:
    # so it comes into `Resolved`, and to all that frames are told by.

    min_confidence: float | None = described("Below it the frame was refused, or masked; null: any.", None)
    below_min_confidence: Below = described(
        "mask: where the frame's confidence is below min_confidence, pixels without support are 0.", Below.REFUSE
    )
    contact: Contact | None = described("As used; null: it was assumed.", None)
    indentation_mm: float | None = described("As asked for; null: as the pose tells.", None)
    tools: tuple[Tool, ...] = described("As used.", ())
    ghost: float = described("As used; 0: none.", 0.0)
    phase: tuple[float, ...] = described("Numbers of the scene's modes of motion, as used; empty: at rest.", ())
    speckle: Speckle = described("As used.", Speckle.OFF)
    registration: str | None = described("That led the pose into the scene; null: none, it was sent as it is.", None)
    least_confidence = property(_least_confidence)


@dataclass(frozen=True)
class Resolved(Additions):
    """Settings of a request for one scene, checked, with nothing left open."""

    probe: Probe
    height: int  # depth samples that are rendered
    width: int  # scan lines
    outputs: tuple[str, ...] = ("bmode",)
    beam: ElevationBeam = PLANE
    encoding: Encoding = Encoding.UINT8
    display: Display = AS_RENDERED
    breathing: Breathing | None = None  # that is to choose the phase of each frame

    def __hash__(self) -> int:
        """Worked out once: each frame of a stream is asked for by it."""
        return self._hash

    @cached_property
    def _hash(self) -> int:
        return hash(tuple(getattr(self, one.name) for one in fields(self)))

    def breathed(self, motion: Motion | None) -> Resolved:
        """With the phase of this moment, where tissue breathes by the clock: what is told of the frame."""
        if self.breathing is None or motion is None:
            return self
        return replace(self, phase=self.breathing.phase(motion), breathing=None)

    @cached_property
    def picture(self) -> Picture:
        """Size and place of what the frames are shown as. Raises InvalidImageSize for a huge one."""
        return self.display.picture(self.probe, self.height, self.width)

    @cached_property
    def view(self) -> tuple[Any, ...]:
        """All that shows but outputs and encoding: frames that agree in this can be rendered together."""
        return tuple(getattr(self, name) for name in _SHOWING)

    @property
    def pixels(self) -> int:
        """The number of pixels rendered or shown for one pose, whichever is more, over all outputs."""
        picture = self.picture
        return max(self.height * self.width, picture.height * picture.width) * len(self.outputs)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled once, and made once of the same bytes: a stream's settings go to a process with each of its poses."""
        return _unpickled, (_pickled(self),)


@lru_cache(maxsize=256)
def _pickled(settings: Resolved) -> bytes:
    return pickle.dumps({one.name: getattr(settings, one.name) for one in fields(settings)})


@lru_cache(maxsize=256)
def _unpickled(data: bytes) -> Resolved:
    return Resolved(**pickle.loads(data))


_SHOWING = tuple(one.name for one in fields(Resolved) if one.name not in ("outputs", "encoding", "registration"))


@dataclass(frozen=True, kw_only=True)
class SettingsUsed(Additions):
    """The settings of a frame, as used: with its scene and its pose all that is needed to render it again."""

    probe: Probe = described("As used.")
    slice_thickness_mm: float = described("As used: at the focus of the scene's beam; 0: a plane.")
    rendered_height: int = described("Depth samples, before the display settings were applied.")
    rendered_width: int = described("Scan lines, likewise.")
    display: Display = described("As used.", AS_RENDERED)
    height: int = described("H.")
    width: int = described("W.")
    picture: Picture = described("Where the pixels lie.")
    outputs: tuple[str, ...] = described("In the order of the data.", schema={"items": OUTPUT_SCHEMA})
    encoding: Encoding = described("Of the pixels.")

    # Every door tells all of them, by one of these two, or by the codec of messages.

    def document(self) -> dict[str, Any]:
        """The settings as JSON holds them, but for additions that were not asked for."""
        plain = {one.name: one.default for one in fields(Additions)}
        names = (one.name for one in fields(self) if plain.get(one.name, MISSING) != getattr(self, one.name))
        return {name: to_dict(getattr(self, name)) for name in names}

    def texts(self) -> dict[str, str]:
        """The same with a text for each: words and numbers as they are, lists of words with commas, else JSON."""
        return {name: _text(value) for name, value in self.document().items()}


@lru_cache(maxsize=256)
def settings_used(settings: Resolved) -> SettingsUsed:
    return made_of(
        SettingsUsed,
        settings.picture,  # whose height and width are those of what is shown
        settings,
        slice_thickness_mm=settings.beam.thickness_mm,
        rendered_height=settings.height,
        rendered_width=settings.width,
    )


def _text(value: Any) -> str:
    if isinstance(value, list) and value and all(isinstance(one, str) for one in value):
        return ",".join(value)
    return value if isinstance(value, str) else json.dumps(value)


def _check_encoding(encoding: Encoding, outputs: tuple[str, ...]) -> None:
    if encoding.is_image_file and len(outputs) != 1:
        raise InvalidArgument(
            f"encoding {encoding.value} holds exactly one output, got {len(outputs)}", field="encoding"
        )
    if encoding is Encoding.JPEG and OUTPUTS[outputs[0]].is_numbers:
        raise InvalidArgument(f"encoding jpeg would change {outputs[0]}: ask for png, or raw pixels", field="encoding")
