"""What callers fill in. The service checks the values."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Literal, TypeAlias

__all__ = [
    "Below",
    "ConvexProbe",
    "DatasetOptions",
    "Display",
    "Encoding",
    "FrameSettings",
    "LinearProbe",
    "PhasedProbe",
    "Probe",
    "RenderSettings",
]


@dataclass(frozen=True)
class LinearProbe:
    """Parallel scan lines; 0 < width, 0 ≤ near < far."""

    width_mm: float
    near_mm: float
    far_mm: float
    kind: Literal["linear"] = field(default="linear", repr=False, kw_only=True)


@dataclass(frozen=True)
class ConvexProbe:
    """A fan of scan lines; `near_mm` is the radius of the face; 0 < angle ≤ 175."""

    opening_angle_deg: float
    near_mm: float
    far_mm: float
    kind: Literal["convex"] = field(default="convex", repr=False, kw_only=True)


@dataclass(frozen=True)
class PhasedProbe:
    """A fan of scan lines from the centre of the face; 0 < angle ≤ 175."""

    opening_angle_deg: float
    far_mm: float
    kind: Literal["phased"] = field(default="phased", repr=False, kw_only=True)


Probe: TypeAlias = LinearProbe | ConvexProbe | PhasedProbe


@dataclass(frozen=True, kw_only=True)
class DatasetOptions:
    """How a dataset is read, as the options of `ultragray dataset check`; empty: as it is stored."""

    crop: str = ""  # columns,rows of a sequence's image: 188:632,12:600
    image_size: str = ""  # WIDTHxHEIGHT
    frames: str = ""  # frames of a sequence to read at all: 0:90,100:120:2
    train_frames: str = ""
    val_frames: str = ""


class Below(str, Enum):
    """What becomes of a frame whose confidence is below the limit."""

    REFUSE = "refuse"
    MASK = "mask"


@dataclass(frozen=True)
class Display:
    """Settings of a display. The defaults show frames as they are.

    Gain, dynamic range and time-gain compensation change B-mode only; the others change every output.
    """

    gain_db: float = 0.0
    """Added to every echo."""
    dynamic_range_db: float = 60.0
    """From white down to black."""
    tgc_db: tuple[float, ...] = ()
    """Gains at evenly spaced depths from the first row shown to the last, linear in between."""
    depth_mm: float | None = None
    """Deeper rows, counted from the face, are cut off."""
    flip: bool = False
    """Left and right change places."""
    pixel_mm: float | None = None
    """Scan conversion to square pixels of this size."""


@dataclass(frozen=True, kw_only=True)
class FrameSettings:
    """What to render, but for the scene and the poses. None: as the scene has it."""

    height: int | None = None
    """Depth samples. Default: as trained, else 512."""
    width: int | None = None
    """Scan lines. Default: as trained, else 512."""
    probe: Probe | None = None
    """Instead of the scene's own."""
    min_confidence: float | None = None
    """0 to 1; what is below is refused, or masked."""
    below_min_confidence: Below = Below.REFUSE
    """mask: pixels of such frames that Gaussians do not support are 0."""
    display: Display | None = None
    """Gain, depth, scan conversion ...; default: as rendered."""
    outputs: tuple[str, ...] = ("bmode",)
    """Some of bmode, echo, transmittance, coverage, labels."""


class Encoding(str, Enum):
    """The form that pixels come in."""

    UINT8 = "uint8"
    FLOAT32 = "float32"
    PNG = "png"
    JPEG = "jpeg"
    NPZ = "npz"


@dataclass(frozen=True, kw_only=True)
class RenderSettings(FrameSettings):
    """What to render, and the form that it comes in, where neither an Accept header nor a file format decides that."""

    encoding: Encoding = Encoding.UINT8
    """Form of the pixels."""
