"""What the render pool is asked and what it answers. Free of torch: the service process imports this."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import Any

import numpy as np

from ultragray.confidence import Extrapolation
from ultragray.display.settings import AS_RENDERED, Display
from ultragray.probe import FloatArray, Picture, Probe


class Encoding(str, Enum):
    """The form of the pixels in `RenderResult.data`."""

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


class Priority(IntEnum):
    """Waiting requests of a lower value are rendered first."""

    INTERACTIVE = 0
    BATCH = 1


class Below(str, Enum):
    """What becomes of a frame whose confidence is below the limit."""

    REFUSE = "refuse"
    MASK = "mask"  # pixels that Gaussians do not support are 0


@dataclass(frozen=True)
class Trust:
    """The confidence that frames must have, and what else becomes of them."""

    min_confidence: float | None = None  # None: any
    below: Below = Below.REFUSE


ANY_CONFIDENCE = Trust()


@dataclass(frozen=True, eq=False)
class RenderRequest:
    """Frames of one scene for some poses; everything but the scene has been checked by the caller."""

    scene: str
    poses: FloatArray  # [C, 4, 4] mm, probe→scene, exact (check_poses was applied)
    probe: Probe | None = None  # None: the probe the scene was trained with
    height: int | None = None  # None: the height of the scene's training images, else 512
    width: int | None = None
    outputs: tuple[str, ...] = ("bmode",)
    encoding: Encoding = Encoding.UINT8
    priority: Priority = Priority.INTERACTIVE
    deadline: float | None = None  # time.monotonic() in seconds; past it the request is dropped
    display: Display = AS_RENDERED
    trust: Trust = ANY_CONFIDENCE


@dataclass(frozen=True, eq=False)
class RenderResult:
    """Frames, and all it takes to render them again. H and W are those of `picture`.

    `data` holds, by encoding: uint8 (round(255·x)) and float32: the outputs one after another, each
    [C, H, W] in C order, little endian; png and jpeg: one image file [H, W]; npz: an archive with one array
    [C, H, W] per output, float32 (labels: uint8), `poses` [C, 4, 4] float64 mm, and the strings `scene`,
    `scene_sha256`, `renderer`. In each, labels are the numbers themselves, and none are in a jpeg.
    """

    scene: str
    scene_sha256: str
    renderer: str  # such as "ultragray/0.1.0 cpu-avx512"
    poses: FloatArray  # [C, 4, 4] mm, as used
    probe: Probe
    rendered_height: int  # depth samples
    rendered_width: int  # scan lines
    display: Display
    picture: Picture  # what the frames are shown as
    outputs: tuple[str, ...]
    encoding: Encoding
    data: bytes
    queue_ms: float  # from the call to the start of its rendering
    render_ms: float  # of the batch it was rendered in
    encode_ms: float
    extrapolations: tuple[Extrapolation, ...]  # [C]
    batch_size: int  # poses rendered together

    @property
    def height(self) -> int:
        """H of the frames."""
        return self.picture.height

    @property
    def width(self) -> int:
        """W of the frames."""
        return self.picture.width
