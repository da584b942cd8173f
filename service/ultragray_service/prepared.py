"""Folders that take a while to make and are kept: made once each, by a helper process, one at a time."""

from __future__ import annotations

import asyncio
import os
import secrets
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ultragray.errors import DatasetInvalid, UltragrayError
from ultragray_workers.comparison import PROGRESS_NAME
from ultragray_workers.dataset_store import sync_folder

from .helper_process import run_helper
from .settings import Settings

TIMEOUT_S = 1800.0
KEPT_FOLDERS = 32
_FAILURE_KEPT_S = 60.0  # then it is tried again
_PREFIX = ".making-"


@dataclass(frozen=True)
class Preparation:
    """How far a folder is; `error` where it could not be made."""

    state: Literal["running", "ready", "failed"]
    progress: float  # 0 to 1
    error: UltragrayError | None = None


class PreparedFolders:
    """The folders below `folder`, by a key that names what is in them. All methods belong to one event loop."""

    def __init__(self, folder: Path, module: str, what: str, settings: Settings) -> None:
        """`module` of ultragray_workers fills a folder; `what` says in errors what it does."""
        self.folder = folder
        self._module = module
        self._what = what
        self._memory_bytes = settings.dataset_memory_mb << 20
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._making: dict[str, Path] = {}
        self._failures: dict[str, tuple[float, UltragrayError]] = {}
        self._one_at_a_time = asyncio.Lock()

    async def prepare(self, key: str, request: dict[str, Any]) -> Preparation:
        """Begins to make the folder unless it is there, or failed a minute ago; how far it is."""
        if await asyncio.to_thread(self._touch, key):
            return Preparation("ready", 1.0)
        failed = self._failures.get(key)
        if failed is not None and time.monotonic() - failed[0] < _FAILURE_KEPT_S:
            return Preparation("failed", 0.0, failed[1])
        self._task(key, request)
        return Preparation("running", await asyncio.to_thread(self._progress, key))

    async def path(self, key: str, request: dict[str, Any]) -> Path:
        """The folder, made first where it is not there. Raises what the helper process raises, DeadlineExceeded."""
        if not await asyncio.to_thread(self._touch, key):
            await asyncio.shield(self._task(key, request))
            if (failed := self._failures.get(key)) is not None:
                raise failed[1]
        return self.folder / key

    def end(self) -> None:
        """Ends what is being made: the service stops."""
        for task in self._tasks.values():
            task.cancel()

    async def remove_stale(self) -> None:
        """Removes what services that died while they made a folder left."""
        await asyncio.to_thread(self._remove_stale)

    def _task(self, key: str, request: dict[str, Any]) -> asyncio.Task[None]:
        task = self._tasks.get(key)
        if task is None:
            self._failures.pop(key, None)
            task = self._tasks[key] = asyncio.create_task(self._make(key, request))
            task.add_done_callback(lambda _: self._tasks.pop(key, None))
        return task

    async def _make(self, key: str, request: dict[str, Any]) -> None:
        making = self._making[key] = self.folder / f"{_PREFIX}{secrets.token_hex(8)}"
        try:
            async with self._one_at_a_time:
                await asyncio.to_thread(making.mkdir, parents=True)
                await run_helper(
                    self._module,
                    {**request, "folder": str(making), "memory_bytes": self._memory_bytes},
                    what=self._what,
                    timeout_s=TIMEOUT_S,
                    killed=DatasetInvalid,
                )
                await asyncio.to_thread(self._keep, making, key)
        except UltragrayError as error:
            self._failures[key] = (time.monotonic(), error)
        finally:
            del self._making[key]
            await asyncio.shield(asyncio.to_thread(shutil.rmtree, making, ignore_errors=True))

    def _touch(self, key: str) -> bool:
        """Whether the folder is there; if so it is the last to go."""
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
        for path in making.iterdir():
            sync_folder(path)  # a file likewise
        sync_folder(making)
        try:
            making.rename(self.folder / key)
        except OSError:
            if not (self.folder / key).is_dir():  # else another service was quicker
                raise
        sync_folder(self.folder)
        kept = sorted(self._folders(lambda name: not name.startswith(".")), key=_age_s)
        for folder in kept[KEPT_FOLDERS:]:
            shutil.rmtree(folder, ignore_errors=True)

    def _remove_stale(self) -> None:
        for folder in self._folders(lambda name: name.startswith(_PREFIX)):
            if _age_s(folder) > TIMEOUT_S:
                shutil.rmtree(folder, ignore_errors=True)

    def _folders(self, wanted: Callable[[str], bool]) -> list[Path]:
        if not self.folder.is_dir():
            return []
        return [path for path in self.folder.iterdir() if wanted(path.name)]


def _age_s(path: Path) -> float:
    try:
        return time.time() - path.stat().st_mtime
    except FileNotFoundError:
        return 0.0
