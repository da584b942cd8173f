"""What passes between the pool's callers, the pool, and its worker processes. Free of torch.

A frame's way: `RenderRequest` (settings resolved, poses checked) → `Task` (to a worker, with requests that share its
view) → planes, in the worker → `Rendered` (its report; the pixels lie in shared memory) → `RenderResult`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Generic, Protocol

from typing_extensions import TypeVar

from ultragray.contract import Contract, described
from ultragray.errors import UltragrayError
from ultragray.geometry.probe import FloatArray
from ultragray.learn.localization.settings import Localization, LocalizationSettings
from ultragray.learn.planning.settings import PlanSettings, ViewPlan
from ultragray.rendering.settings import Resolved
from ultragray.rendering.volumes import SliceView
from ultragray.scene.confidence import Extrapolation
from ultragray_workers.pool.channel import MAX_DESCRIPTORS
from ultragray_workers.pool.turns import UNKNOWN_CALLER, Caller
from ultragray_workers.storage.local import FileVersion

_IMAGE_HEADER_BYTES = 2**16
MAX_BATCH_POSES = MAX_DESCRIPTORS  # the memory of each part goes along with the task


@dataclass(frozen=True)
class PoolConfig(Contract):
    """Sizes of a pool. Raises InvalidArgument for values that no pool can have."""

    processes: int = described(
        "Render processes; 0: one per GPU, on the CPU one. More than there are GPUs share them.",
        0,
        low=0,
        high=256,
        topic="Compute",
    )
    threads_per_process: int = described(
        "Render threads of each; 0: cores // processes.", 0, low=0, high=1024, topic="Compute"
    )
    queue_limit_frames: int = described(
        "Frames that may wait, interactive and batch frames each; beyond: QUEUE_FULL.", 256, low=1, high=100_000
    )
    client_limit_frames: int = described(
        "Of those, frames of one client: of one name where keys are asked for, else of one address.",
        256,
        low=1,
        high=100_000,
    )
    max_queue_ms: float = described(
        "How long frames of others may keep an interactive request waiting; one that would wait longer is refused at "
        "once (QUEUE_FULL), and told when to try again.",
        1000.0,
        above=0.0,
        high=3_600_000.0,
    )
    max_batch_poses: int = described(
        "Waiting poses of one scene that are rendered together; fewer above 512x512 pixels.",
        16,
        low=1,
        high=MAX_BATCH_POSES,
    )
    memory_budget_bytes: int = described(
        "Of loaded scenes, per process, where they are rendered.", 4 * 2**30, low=1, high=2**63
    )
    max_footprint_pixels: int = described(
        "Cost of one frame: pixels in the footprints of the Gaussians that it cuts, about 3e7 of 500,000 usual ones at "
        "512x512; beyond: FRAME_TOO_COSTLY.",
        2**31,
        low=1,
        high=2**62,
    )
    worker_grace_s: float = described(
        "How long a render process may leave a task untouched, or owe an answer past its deadline, before it is killed "
        "and replaced, and its frames are rendered again.",
        5.0,
        above=0.0,
        high=3600.0,
    )
    worker_timeout_s: float = described(
        "How long a render process may take to load a scene before it is killed and replaced.",
        120.0,
        above=0.0,
        high=86_400.0,
    )
    backend: str = "auto"


@dataclass(frozen=True, eq=False)
class Search:
    """Something that is looked for in a scene, by a task of its own. Its data go through the memory of its request."""

    data: bytes
    settings: LocalizationSettings | PlanSettings

    @property
    def view(self) -> tuple[Any, ...]:
        return (self.settings,)


@dataclass(frozen=True, eq=False)
class Sought(Search):
    """A real frame: a PNG file, or uint8 row by row where there is a size. Read and checked where it is looked for."""

    settings: LocalizationSettings
    size: tuple[int, int] | None  # height and width


@dataclass(frozen=True, eq=False)
class NextViews(Search):
    """Views that would teach the scene most. The data are the poses in reach, float64 [C, 4, 4]; none: the settings
    say what is.
    """

    settings: PlanSettings
    standard_plane: FloatArray | None  # [4, 4] mm
    start: FloatArray | None  # [4, 4] mm


F = TypeVar("F", bound=Localization | ViewPlan, default=Localization)
S = TypeVar("S", bound=Resolved | SliceView, default=Resolved)  # settings of a frame, or of a slice
W = TypeVar("W", bound=Resolved | SliceView | Search, default=Resolved)  # what is to be done at each pose


class Priority(IntEnum):
    """Waiting requests of a lower value are rendered first."""

    INTERACTIVE = 0
    BATCH = 1


@dataclass(frozen=True)
class Place:
    """Room in a destination."""

    slot: int  # the destination's number for it
    size: int  # bytes
    descriptor: int  # of the file
    offset: int  # in the file, bytes


class Destination(Protocol):
    """Memory of a caller, which its frames are rendered into."""

    def lend(self, size: int) -> Place | None:
        """Room for so many bytes, which no other frame gets; None where there is none."""

    def take_back(self, place: Place) -> None:
        """Room that no frame came into, and that no process writes to any more."""


@dataclass(frozen=True, eq=False)
class RenderRequest(Generic[W]):
    """Frames, or slices, of one scene for some poses; everything but the scene has been checked by the caller.

    For a `Search` nothing is rendered at the one pose: it is where that for a frame starts.
    """

    scene: str
    settings: W
    poses: FloatArray  # [C, 4, 4] mm, probe→scene, exact (check_poses was applied)
    priority: Priority = Priority.INTERACTIVE
    deadline: float | None = None  # time.monotonic() in seconds; past it the request is given up
    version: FileVersion | None = None  # of the scene's file that the settings are for; None: any
    caller: Caller = UNKNOWN_CALLER
    begin_by: float | None = None  # time.monotonic() in seconds; it is given up where none of it has begun by then
    destination: Destination | None = None  # of the reply, but for an npz; None: RenderResult.data


def reply_bytes(settings: Resolved | SliceView, poses: int) -> int:
    """All pixels of a reply; for an image file, more than it takes. Of an archive its arrays alone."""
    pixels = poses * len(settings.outputs) * settings.picture.height * settings.picture.width
    size = pixels * settings.encoding.pixel_type.itemsize
    return 2 * size + _IMAGE_HEADER_BYTES if settings.encoding.is_image_file else size


class SceneChangedError(Exception):
    """The file of a scene is not of the version that the settings of a request are for: it was not rendered."""


@dataclass(frozen=True, eq=False)
class RenderResult(Generic[S]):
    """Frames or slices, and all it takes to render them again. H and W are those of the picture.

    `data` holds, by encoding: uint8 (round(255·x)), float32 and float16: the outputs one after another, each
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
    place: Place | None = None  # of the data in that destination, whose caller gives it back

    @property
    def height(self) -> int:
        return self.settings.picture.height

    @property
    def width(self) -> int:
        return self.settings.picture.width


@dataclass(frozen=True, eq=False)
class SearchResult(Generic[F]):
    """What a search has found, and what it took."""

    scene: str
    scene_sha256: str
    renderer: str
    found: F
    queue_ms: float  # from the call to the start of the search
    search_ms: float


# Messages between the service and its child processes. Free of torch.


@dataclass(frozen=True)
class ForkWorker:
    """To a template process: fork a worker that serves the channel sent along."""

    pool: PoolConfig
    number: int = 0  # of its place in the pool: tells which GPU it takes


@dataclass(frozen=True)
class ForkTemplate:
    """To a template process: fork another template that serves the channel sent along."""


@dataclass(frozen=True)
class Hello:
    """A child's first message: it is ready, or it cannot work because of `error`."""

    pid: int
    gpus: int = 0  # that the pool's scenes could lie on; 0 where they are rendered on the CPU
    error: UltragrayError | None = None


@dataclass(frozen=True, eq=False)
class TaskPart(Generic[W]):
    """Some poses of one request, of `total`, starting with its pose number `first`."""

    settings: W
    poses: FloatArray  # [C, 4, 4] mm
    first: int
    total: int
    deadline: float | None  # time.monotonic() in seconds, as in all processes; past it nobody takes its frames
    offset: int = 0  # of the request's reply in its memory, bytes
    room: int | None = None  # for the whole reply there, bytes; None: any

    def name_pose(self, index: int) -> str:
        """One of its poses as the caller names it."""
        return "pose" if self.total == 1 else f"poses[{self.first + index}]"


@dataclass(frozen=True, eq=False)
class Task(Generic[W]):
    """Parts of requests to be done together: they share a view, and so the kind of their settings.

    The memory of each part's request goes along, and an Answer comes back for each.
    """

    scene: str
    path: str
    version: FileVersion | None  # that the scene's file must have; None: any
    parts: tuple[TaskPart[W], ...]

    @property
    def view(self) -> W:
        """Settings whose outputs and encoding are those of the first part only, and all else that of every part."""
        return self.parts[0].settings


@dataclass(frozen=True, eq=False)
class PackTask:
    """Make an .npz of rendered frames. The memory that holds them and the memory for it go along."""

    scene: str
    scene_sha256: str
    renderer: str
    settings: Resolved
    poses: FloatArray  # [C, 4, 4] mm
    extrapolations: tuple[Extrapolation, ...]  # [C]


@dataclass(frozen=True)
class LoadTask:
    scene: str
    path: str


@dataclass(frozen=True)
class UnloadTask:
    scene: str


AnyTask = Task[Any] | PackTask | LoadTask | UnloadTask


@dataclass(frozen=True)
class Rendered:
    size: int  # bytes of the reply so far: all of `data` when this was the request's only part
    scene_sha256: str
    renderer: str
    started: float  # time.monotonic() in seconds
    render_ms: float
    encode_ms: float
    first: int = 0  # pose of the request that the part begins with
    extrapolations: tuple[Extrapolation, ...] = ()  # of the part's poses
    found: Localization | ViewPlan | None = None  # of a search


@dataclass(frozen=True)
class Loading:
    """A worker's word that its task takes longer: it loads a scene from its file, or has done so."""

    begins: bool


Outcome = Rendered | UltragrayError | SceneChangedError | None


@dataclass(frozen=True)
class Answer:
    """The outcome of part `part` of a task (0 where it has none); after the `last` one the worker is idle."""

    part: int
    outcome: Outcome
    last: bool
    resident: tuple[str, ...]  # scenes the worker holds now
