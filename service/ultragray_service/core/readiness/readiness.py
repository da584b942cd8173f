"""Whether the service is ready, part by part."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass

from ultragray.contract import described
from ultragray.errors import UltragrayError
from ultragray_service.core.readiness.watched import WatchedPart
from ultragray_service.core.scene_places import ScenePlaces
from ultragray_workers.errors import ArtifactFolderUnavailable, DatabaseUnavailable
from ultragray_workers.jobs.queue.database import JobDatabase


@dataclass(frozen=True)
class Component:
    """A part of the service."""

    ready: bool = described("Whether it is in order.")
    detail: str | None = described("Why it is not: one sentence.")

    @classmethod
    def of(cls, problem: UltragrayError | None) -> Component:
        """A part with that problem."""
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
        """`require_serving`, `require_frames`: raise what keeps everything, and frames, from being answered.

        `without_jobs`: whether the service is ready as soon as frames are.
        """
        self._require_serving, self._require_frames = require_serving, require_frames
        self._scenes = scenes
        self._without_jobs = without_jobs
        self._jobs = WatchedPart("the database of the jobs", lambda: database().check(), DatabaseUnavailable)
        self._artifacts = WatchedPart(
            "the artifact folder", lambda: database().folder.check_writable(), ArtifactFolderUnavailable
        )
        self._tasks: list[asyncio.Task[None]] = []

    async def start(self) -> None:
        """Checks every part once, and from now on at an interval."""
        parts = (self._jobs, self._artifacts)
        await asyncio.gather(*(part.look() for part in parts))
        self._tasks = [asyncio.ensure_future(part.run()) for part in parts]

    def close(self) -> None:
        """Ends the checks."""
        for task in self._tasks:
            task.cancel()

    @property
    def components(self) -> Components:
        """Every part as it was found last."""
        return Components(*(Component.of(problem) for problem in self._problems()))

    @property
    def problem(self) -> UltragrayError | None:
        """Why the service is not ready; None: it is."""
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
