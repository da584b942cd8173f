"""Pictures and figures that helper processes make in the background, once each, and that are kept in folders."""

from __future__ import annotations

import asyncio
import logging
import os
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from ultragray.errors import DatasetInvalid, UltragrayError
from ultragray.files.atomic import sync
from ultragray.settings import Encoding
from ultragray_service.core.helper_processes import HelperProcesses
from ultragray_service.core.own_thread import in_own_thread, to_its_end
from ultragray_service.settings import Settings
from ultragray_workers.claims import claimed_folder, remove_abandoned, remove_whole, storage_full
from ultragray_workers.errors import ArtifactNotFound, DatasetNotFound, Draining
from ultragray_workers.helpers.helper import PROGRESS_NAME
from ultragray_workers.helpers.picture_stack import read_picture
from ultragray_workers.pool.process.encoding import encode_image

TIMEOUT_S = 1800.0
KEPT_FOLDERS = 32
_FAILURE_KEPT_S = 60.0  # then it is tried again
_PREFIX, _CONTENT = ".making-", "content"

_log = logging.getLogger("ultragray.service")


@dataclass(frozen=True)
class Preparation:
    """The progress of a folder; `error` where it could not be made."""

    state: Literal["running", "ready", "failed"]
    progress: float  # 0 to 1
    error: UltragrayError | None = None


class Prepared:
    """Base of a kind of pictures and figures: one folder for each key, which names what is in it.

    A subclass says in which folder of the artifact folder its own lie, what its helper process does, in the words of
    errors, and which function fills a folder: it takes `folder`, `artifact_folder`, `storage` where hosts share one,
    and what the kind asks of it. Keys end with the SHA-256 of the dataset that the pictures are of. The folders that
    were asked for last are kept: KEPT_FOLDERS, and beside the newest no more bytes than a dataset may have. All methods
    belong to one event loop.
    """

    name: ClassVar[str]
    what: ClassVar[str]
    fill: ClassVar[Callable[..., None]]  # a staticmethod

    def __init__(self, settings: Settings, processes: HelperProcesses) -> None:
        self._places: dict[str, str | int] = {"artifact_folder": str(settings.working_folder)}
        if not isinstance(settings.artifacts, Path):
            self._places |= {"storage": str(settings.artifacts), "max_copies_bytes": settings.max_cache_bytes}
        self.folder = settings.working_folder / self.name
        self._processes = processes
        self._kept_bytes = settings.max_dataset_bytes
        self._tasks: dict[str, asyncio.Task[UltragrayError | None]] = {}
        self._making: dict[str, Path] = {}
        self._failures: dict[str, tuple[float, UltragrayError]] = {}
        self._ended = False

    async def prepare(self, key: str, **arguments: str | None) -> Preparation:
        """Begin to make the folder unless it is there, or failed a minute ago; how far it is. Raises Draining."""
        if await asyncio.to_thread(self._touch, key):
            return Preparation("ready", 1.0)
        if (error := self._failure(key)) is not None:
            return Preparation("failed", 0.0, error)
        self._task(key, arguments)
        return Preparation("running", await asyncio.to_thread(self._progress, key))

    async def path(self, key: str, **arguments: str | None) -> Path:
        """The folder, made first where it is not there.

        Raises what the helper process raises, also where it did so a minute ago, DeadlineExceeded, MemoryExceeded,
        StorageFull, Draining, and ArtifactNotFound where it is removed meanwhile.
        """
        if await asyncio.to_thread(self._touch, key):
            return self.folder / key
        if (error := self._failure(key)) is None:
            task = self._task(key, arguments)
            await asyncio.wait({task})
            if task.cancelled():
                if self._ended:
                    raise Draining("the service is stopping")
                raise ArtifactNotFound("what was to be shown has been deleted meanwhile")
            error = task.result()
        if error is not None:
            raise error.with_traceback(None)
        return self.folder / key

    async def picture_png(self, key: str, index: int, *names: str) -> bytes | None:
        """Frame `index` of the stacks of these names, side by side; None where one is not there (any more)."""

        def read() -> bytes | None:
            pictures = [read_picture(self.folder / key, name, index) for name in names]
            found = [picture for picture in pictures if picture is not None]
            if len(found) < len(names):
                return None
            return encode_image(np.concatenate(found, axis=1), Encoding.PNG).tobytes()

        return await asyncio.to_thread(read)

    async def settled(self, is_asked: Callable[[str], bool]) -> None:
        """Wait until no folder is being made whose key `is_asked` accepts."""
        if tasks := {task for key, task in self._tasks.items() if is_asked(key)}:
            await asyncio.wait(tasks)

    def end(self) -> None:
        """Stop what is being made; nothing begins any more."""
        self._ended = True
        for task in self._tasks.values():
            task.cancel()

    async def forget(self, is_doomed: Callable[[str], bool]) -> None:
        """Remove the folders whose key `is_doomed` accepts, also those that are being made."""
        doomed = {task for key, task in self._tasks.items() if is_doomed(key)}
        for task in doomed:
            task.cancel()
        if doomed:
            await asyncio.wait(doomed)

        def remove() -> None:
            for folder in self._kept():
                if is_doomed(folder.name):
                    remove_whole(folder, _PREFIX)

        await in_own_thread(remove)

    async def remove_stale(self) -> None:
        """Remove what services that died while they made a folder left."""
        await in_own_thread(lambda: remove_abandoned(self.folder, _PREFIX))

    def _task(self, key: str, arguments: dict[str, str | None]) -> asyncio.Task[UltragrayError | None]:
        if self._ended:
            raise Draining("the service is stopping")
        task = self._tasks.get(key)
        if task is None:
            task = self._tasks[key] = asyncio.create_task(self._make(key, arguments))
            task.add_done_callback(lambda _: self._tasks.pop(key, None))
        return task

    async def _make(self, key: str, arguments: dict[str, str | None]) -> UltragrayError | None:
        """Make the folder; None, or why that failed."""
        claim = ExitStack()
        error: UltragrayError | None = None

        def begin() -> Path:
            making = claim.enter_context(claimed_folder(self.folder, _PREFIX)) / _CONTENT
            making.mkdir()
            return making

        try:
            with storage_full(self.what):
                making = self._making[key] = await to_its_end(begin)
                await self._processes.run(
                    self.fill,
                    {**arguments, **self._places, "folder": str(making)},
                    what=self.what,
                    timeout_s=TIMEOUT_S,
                    killed=DatasetInvalid,
                )
                await to_its_end(lambda: self._keep(making, key))
        except UltragrayError as caught:
            error = caught
        except Exception:
            _log.exception(f"{self.what} failed unexpectedly")
            error = UltragrayError(f"{self.what} failed unexpectedly, see the log")
        finally:
            self._making.pop(key, None)
            await to_its_end(claim.close)
        if error is not None and not isinstance(error, DatasetNotFound):  # another name may have the same content
            self._failures[key] = (time.monotonic(), error)
        return error

    def _failure(self, key: str) -> UltragrayError | None:
        """Why it failed, less than a minute ago."""
        now = time.monotonic()
        self._failures = {key: one for key, one in self._failures.items() if now - one[0] < _FAILURE_KEPT_S}
        return self._failures[key][1] if key in self._failures else None

    def _touch(self, key: str) -> bool:
        """Whether the folder is there; it then counts as the one asked for last."""
        try:
            os.utime(self.folder / key)
        except FileNotFoundError:
            return False
        return True

    def _progress(self, key: str) -> float:
        making = self._making.get(key)
        try:
            return 0.0 if making is None else float((making / PROGRESS_NAME).read_text())
        except (FileNotFoundError, ValueError):
            return 0.0

    def _keep(self, making: Path, key: str) -> None:
        for path in (*making.iterdir(), making):
            sync(path)
        try:
            making.rename(self.folder / key)
        except OSError:
            if not (self.folder / key).is_dir():  # else another service was quicker
                raise
        sync(self.folder)
        self._remove_oldest(key)
        remove_abandoned(self.folder, _PREFIX)

    def _remove_oldest(self, newest: str) -> None:
        others = sorted((folder for folder in self._kept() if folder.name != newest), key=_age_s)
        held_bytes = 0
        for count, folder in enumerate(others, 2):
            held_bytes += _size_bytes(folder)
            if count > KEPT_FOLDERS or held_bytes > self._kept_bytes:
                remove_whole(folder, _PREFIX)

    def _kept(self) -> list[Path]:
        return [path for path in self.folder.glob("*") if not path.name.startswith(".")]


def _age_s(path: Path) -> float:
    try:
        return time.time() - path.stat().st_mtime
    except FileNotFoundError:
        return 0.0


def _size_bytes(folder: Path) -> int:
    try:
        return sum(path.stat().st_size for path in folder.iterdir())
    except FileNotFoundError:
        return 0
