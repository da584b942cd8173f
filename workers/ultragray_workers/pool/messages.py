"""Messages between the service and its child processes. Free of torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic

from ultragray.confidence import Extrapolation
from ultragray.errors import UltragrayError
from ultragray.learn.localization.settings import Localization, LocalizationSettings
from ultragray.probe import FloatArray
from ultragray.settings import Resolved
from ultragray.volumes.plane import SliceView
from ultragray_workers.pool.types import S
from ultragray_workers.storage.local import FileVersion


@dataclass(frozen=True)
class ForkWorker:
    """To a template process: fork a worker that serves the channel sent along."""

    backend: str
    number: int  # of its place in the pool, from 0: tells which GPU it takes
    processes: int  # in the pool; 0: one per GPU, or one
    threads: int  # 0: the cores this process may use, divided by the number of processes
    memory_budget_bytes: int
    max_footprint_pixels: int  # of a frame


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
class RenderPart(Generic[S]):
    """Some poses of one request, of `total`, starting with its pose number `first`."""

    settings: S
    poses: FloatArray  # [C, 4, 4] mm
    first: int
    total: int
    deadline: float | None  # time.monotonic() in seconds, as in all processes; past it nobody takes its frames

    def name_pose(self, index: int) -> str:
        """One of its poses as the caller names it."""
        return "pose" if self.total == 1 else f"poses[{self.first + index}]"


@dataclass(frozen=True, eq=False)
class RenderTask:
    """Render parts together, which share a view. One memory descriptor per part goes along; one Answer per part comes
    back.
    """

    scene: str
    path: str
    version: FileVersion | None  # that the scene's file must have; None: any
    parts: tuple[RenderPart, ...]

    @property
    def view(self) -> Resolved:
        """Settings whose outputs and encoding are those of the first part only, and all else that of every part."""
        return self.parts[0].settings


@dataclass(frozen=True, eq=False)
class SliceTask:
    """Sample parts of slices. As of a RenderTask, a memory descriptor goes along and an Answer comes back for each."""

    scene: str
    path: str
    version: FileVersion | None
    parts: tuple[RenderPart[SliceView], ...]


@dataclass(frozen=True, eq=False)
class LocalizeTask:
    """Look for a real frame. The memory that holds it goes along."""

    scene: str
    path: str
    version: FileVersion | None  # that the scene's file must have; None: any
    start: FloatArray  # [4, 4] mm
    image_bytes: int
    size: tuple[int, int] | None  # height and width of grey pixels; None: it is a PNG file
    settings: LocalizationSettings


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


Task = RenderTask | SliceTask | LocalizeTask | PackTask | LoadTask | UnloadTask


@dataclass(frozen=True)
class Rendered:
    """A worker's report on one part."""

    size: int  # bytes of the reply so far: all of `data` when this was the request's only part
    scene_sha256: str
    renderer: str
    started: float  # time.monotonic() in seconds
    render_ms: float
    encode_ms: float
    first: int = 0  # pose of the request that the part begins with
    extrapolations: tuple[Extrapolation, ...] = ()  # of the part's poses
    found: Localization | None = None  # of a frame that was looked for


@dataclass(frozen=True)
class Loading:
    """A worker's word that its task takes longer: it loads a scene from its file, or has done so."""

    begins: bool


@dataclass(frozen=True)
class Outdated:
    """A worker's report that it did not render: the scene's file is of another version."""


@dataclass(frozen=True)
class Answer:
    """The outcome of part `part` of a task (0 where it has none); after the `last` one the worker is idle."""

    part: int
    outcome: Rendered | Outdated | UltragrayError | None
    last: bool
    resident: tuple[str, ...]  # scenes the worker holds now
