"""Whether the service is ready, part by part: frames when asked, database and folder by tasks of their own."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from dataclasses import dataclass

from ultragray.contract import described
from ultragray.errors import UltragrayError
from ultragray_service.core.scenes import ScenePlaces
from ultragray_service.core.threads import in_own_thread
from ultragray_workers.errors import ArtifactFolderUnavailable, DatabaseUnavailable, NotReady
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.rounds import repeat

CHECK_INTERVAL_S = 5.0
PATIENCE_S = 5.0  # with a check that does not end

_log = logging.getLogger("ultragray.service")


class WatchedPart:
    """What a part said last: at most CHECK_INTERVAL_S + PATIENCE_S ago."""

    def __init__(self, name: str, check: Callable[[], None], error: type[UltragrayError]) -> None:
        """`check` blocks, and raises where the part is not in order; `error`: of one that does not return."""
        self._name, self._check = name, check
        self._silent = error(f"{name} has not answered for {PATIENCE_S:g} s")
        self._checking: asyncio.Task[None] | None = None
        self.problem: UltragrayError | None = NotReady("the service is starting")

    async def run(self) -> None:
        await repeat(f"the watch over {self._name}", _log, CHECK_INTERVAL_S, self.look)

    async def look(self) -> None:
        """Checks once. A check that hangs stays the only one until it ends."""
        if self._checking is None:
            self._checking = asyncio.ensure_future(in_own_thread(self._check))
        await asyncio.wait({self._checking}, timeout=PATIENCE_S)
        problem: UltragrayError | None = None
        if not self._checking.done():
            problem = self._silent
        else:
            ended, self._checking = self._checking, None
            try:
                ended.result()
            except UltragrayError as error:
                problem = error
        self._take(problem)

    def _take(self, problem: UltragrayError | None) -> None:
        before, self.problem = self.problem, problem
        if problem is not None and (before is None or before.detail != problem.detail):
            _log.warning(problem.detail)
        if problem is None and before is not None and not isinstance(before, NotReady):
            _log.warning(f"{self._name} is in order again")


@dataclass(frozen=True)
class Component:
    """A part of the service."""

    ready: bool = described("Whether it is in order.")
    detail: str | None = described("Why it is not: one sentence.")

    @classmethod
    def of(cls, problem: UltragrayError | None) -> Component:
        return cls(problem is None, None if problem is None else problem.detail)


@dataclass(frozen=True)
class Components:
    """The parts of the service."""

    frames: Component = described("The render processes; as they are now.")
    jobs: Component = described("The jobs' database, into which a row is written and taken back every 5 s.")
    artifacts: Component = described("The artifact folder, in which a file is made and removed every 5 s.")
    scenes: Component = described(
        "The buckets of the scenes, which are listed every 2 s; what is cached is served all the same, for a while."
    )


class Readiness:
    """The parts of one service. Frames are looked at when asked; database and folder by tasks of their own."""

    def __init__(
        self,
        database: Callable[[], JobDatabase],
        *,
        require_serving: Callable[[], None],
        require_frames: Callable[[], None],
        scenes: ScenePlaces,
        without_jobs: bool,
    ) -> None:
        """`require_…`: raise what keeps everything, and frames, away. `without_jobs`: ready as soon as frames are."""
        self._require_serving, self._require_frames = require_serving, require_frames
        self._scenes, self._without_jobs = scenes, without_jobs
        self._jobs = WatchedPart("the database of the jobs", lambda: database().check(), DatabaseUnavailable)
        self._artifacts = WatchedPart(
            "the artifact folder", lambda: database().identity.check_writable(), ArtifactFolderUnavailable
        )
        self._tasks: list[asyncio.Task[None]] = []

    async def start(self) -> None:
        parts = (self._jobs, self._artifacts)
        await asyncio.gather(*(part.look() for part in parts))
        self._tasks = [asyncio.ensure_future(part.run()) for part in parts]

    def close(self) -> None:
        for task in self._tasks:
            task.cancel()

    @property
    def components(self) -> Components:
        return Components(*(Component.of(problem) for problem in self._problems()))

    @property
    def problem(self) -> UltragrayError | None:
        frames, jobs, artifacts, _ = self._problems()
        frames = frames or self._scenes.stale_problem
        return frames if self._without_jobs else frames or jobs or artifacts

    def _problems(self) -> tuple[UltragrayError | None, ...]:
        if (everywhere := _raised_by(self._require_serving)) is not None:
            return everywhere, everywhere, everywhere, everywhere
        return _raised_by(self._require_frames), self._jobs.problem, self._artifacts.problem, self._scenes.problem


def _raised_by(requirement: Callable[[], None]) -> UltragrayError | None:
    try:
        requirement()
    except UltragrayError as error:
        return error
    return None
