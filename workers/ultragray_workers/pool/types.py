"""Requests to the render pool and its results. Free of torch: the service process imports this."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Generic, Protocol

from typing_extensions import TypeVar

from ultragray.confidence import Extrapolation
from ultragray.learn.localization.settings import Localization, LocalizationSettings
from ultragray.probe import FloatArray
from ultragray.settings import Resolved
from ultragray.volumes.plane import SliceView
from ultragray_workers.pool.fairness.turns import UNKNOWN_CALLER, Caller
from ultragray_workers.storage.local import FileVersion

S = TypeVar("S", bound=Resolved | SliceView, default=Resolved)  # settings of a frame, or of a slice


class Priority(IntEnum):
    """Waiting requests of a lower value are rendered first."""

    INTERACTIVE = 0
    BATCH = 1


@dataclass(frozen=True)
class Place:
    """Where a destination has put data."""

    slot: int
    size: int  # bytes


class Destination(Protocol):
    """Memory of a caller, which its frames are put into."""

    def put(self, descriptor: int, size: int) -> Place | None:
        """Copies the first `size` bytes of a file into it; None where it has no room for them."""


@dataclass(frozen=True, eq=False)
class Sought:
    """A real frame that is looked for in a scene. Its pixels are read, and checked, where it is looked for."""

    image: bytes  # a PNG file, or uint8 row by row where there is a size
    size: tuple[int, int] | None  # height and width
    settings: LocalizationSettings


@dataclass(frozen=True, eq=False)
class RenderRequest(Generic[S]):
    """Frames, or slices, of one scene for some poses; everything but the scene has been checked by the caller.

    With `sought` nothing is rendered for the one pose: it is where the search for that frame starts.
    """

    scene: str
    settings: S
    poses: FloatArray  # [C, 4, 4] mm, probe→scene, exact (check_poses was applied)
    priority: Priority = Priority.INTERACTIVE
    deadline: float | None = None  # time.monotonic() in seconds; past it the request is given up
    version: FileVersion | None = None  # of the scene's file that the settings are for; None: any
    caller: Caller = UNKNOWN_CALLER
    begin_by: float | None = None  # time.monotonic() in seconds; it is given up where none of it has begun by then
    destination: Destination | None = None  # of the reply; None: RenderResult.data
    sought: Sought | None = None


class SceneChangedError(Exception):
    """The file of a scene is not of the version that the settings of a request are for."""


@dataclass(frozen=True, eq=False)
class RenderResult(Generic[S]):
    """Frames or slices, and all it takes to render them again. H and W are those of the picture.

    `data` holds, by encoding: uint8 (round(255·x)) and float32: the outputs one after another, each
    [C, H, W] in C order, little endian; png and jpeg: one image file [H, W]; npz: an archive with one array
    [C, H, W] per output, float32 (labels: uint8), `poses` [C, 4, 4] float64 mm, and the strings `scene`,
    `scene_sha256`, `renderer`. In each, labels are the numbers themselves, and none are in a jpeg.
    """

    scene: str
    scene_sha256: str
    renderer: str  # such as "ultragray/0.1.0 cpu-avx512"
    settings: S
    poses: FloatArray  # [C, 4, 4] mm, as used
    data: bytes  # empty where the destination of the request took them
    queue_ms: float  # from the call to the start of its rendering
    render_ms: float  # of the batch it was rendered in
    encode_ms: float
    extrapolations: tuple[Extrapolation, ...]  # [C]; none of slices
    batch_size: int  # poses rendered together
    place: Place | None = None  # of the data in that destination

    @property
    def height(self) -> int:
        """H of the frames."""
        return self.settings.picture.height

    @property
    def width(self) -> int:
        """W of the frames."""
        return self.settings.picture.width


@dataclass(frozen=True, eq=False)
class LocalizeResult:
    """Where a frame was found, and what the search took."""

    scene: str
    scene_sha256: str
    renderer: str
    found: Localization
    queue_ms: float  # from the call to the start of the search
    search_ms: float
