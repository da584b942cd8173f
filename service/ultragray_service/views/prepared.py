"""Folders that take a while to make and are kept: made once each, by a helper process."""

from __future__ import annotations

import asyncio
import fcntl
import logging
import os
import secrets
import shutil
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar

from ultragray.errors import ArtifactNotFound, DatasetInvalid, DatasetNotFound, Draining, UltragrayError
from ultragray_workers.datasets.incoming import storage_full
from ultragray_workers.datasets.store import sync_folder
from ultragray_workers.helpers.helper import PROGRESS_NAME

from ..core.own_thread import in_own_thread
from ..settings import Settings
from .helper_process import run_helper

TIMEOUT_S = 1800.0
KEPT_FOLDERS = 32
_FAILURE_KEPT_S = 60.0  # then it is tried again
_PREFIX = ".making-"
_LOCK_NAME = "lock"  # held by the service that makes a folder, as long as it lives
_FINISHED_WITHIN_S = 60.0  # a folder this young without a lock is about to have its name, or to go

_log = logging.getLogger("ultragray.service")

T = TypeVar("T")


@dataclass(frozen=True)
class Preparation:
    """How far a folder is; `error` where it could not be made."""

    state: Literal["running", "ready", "failed"]
    progress: float  # 0 to 1
    error: UltragrayError | None = None


class PreparedFolders:
    """The folders below `folder`, by a key that names what is in them.

    Those that were asked for last are kept: KEPT_FOLDERS, and beside the newest no more bytes than a dataset may have.
    All methods belong to one event loop.
    """

    def __init__(self, folder: Path, module: str, what: str, settings: Settings, turn: asyncio.Lock) -> None:
        """`module` of ultragray_workers fills a folder when it has `turn`; `what` says in errors what it does."""
        self.folder = folder
        self._module = module
        self._what = what
        self._turn = turn
        self._memory_bytes = settings.dataset_memory_mb << 20
        self._kept_bytes = settings.max_dataset_bytes
        self._tasks: dict[str, asyncio.Task[UltragrayError | None]] = {}
        self._making: dict[str, Path] = {}
        self._failures: dict[str, tuple[float, UltragrayError]] = {}
        self._ended = False

    async def prepare(self, key: str, request: dict[str, Any]) -> Preparation:
        """Begins to make the folder unless it is there, or failed a minute ago; how far it is. Raises Draining."""
        if await asyncio.to_thread(self._touch, key):
            return Preparation("ready", 1.0)
        if (error := self._failure(key)) is not None:
            return Preparation("failed", 0.0, error)
        self._task(key, request)
        return Preparation("running", await asyncio.to_thread(self._progress, key))

    async def path(self, key: str, request: dict[str, Any]) -> Path:
        """The folder, made first where it is not there.

        Raises what the helper process raises, also where it did so a minute ago, DeadlineExceeded, MemoryExceeded,
        StorageFull, Draining, and ArtifactNotFound where it is removed meanwhile.
        """
        if await asyncio.to_thread(self._touch, key):
            return self.folder / key
        if (error := self._failure(key)) is None:
            task = self._task(key, request)
            await asyncio.wait({task})
            if task.cancelled():
                if self._ended:
                    raise Draining("the service is stopping")
                raise ArtifactNotFound("what was to be shown has been deleted meanwhile")
            error = task.result()
        if error is not None:
            raise error.with_traceback(None)
        return self.folder / key

    async def settled(self, is_asked: Callable[[str], bool]) -> None:
        """Returns when none of the keys that `is_asked` says is being made."""
        if tasks := {task for key, task in self._tasks.items() if is_asked(key)}:
            await asyncio.wait(tasks)

    def end(self) -> None:
        """Ends what is being made, for good: the service stops."""
        self._ended = True
        for task in self._tasks.values():
            task.cancel()

    async def remove(self, is_doomed: Callable[[str], bool]) -> None:
        """Removes the folders of the keys that `is_doomed` says, also those that are being made."""
        doomed = {task for key, task in self._tasks.items() if is_doomed(key)}
        for task in doomed:
            task.cancel()
        if doomed:
            await asyncio.wait(doomed)
        await in_own_thread(lambda: _remove(path for path in self._kept() if is_doomed(path.name)))

    async def remove_stale(self) -> None:
        """Removes what services that died while they made a folder left."""
        await in_own_thread(self._remove_stale)

    def _task(self, key: str, request: dict[str, Any]) -> asyncio.Task[UltragrayError | None]:
        if self._ended:
            raise Draining("the service is stopping")
        task = self._tasks.get(key)
        if task is None:
            task = self._tasks[key] = asyncio.create_task(self._make(key, request))
            task.add_done_callback(lambda _: self._tasks.pop(key, None))
        return task

    async def _make(self, key: str, request: dict[str, Any]) -> UltragrayError | None:
        """Why the folder could not be made, if so."""
        making = self._making[key] = self.folder / f"{_PREFIX}{secrets.token_hex(8)}"
        claim = ExitStack()
        error: UltragrayError | None = None
        try:
            with storage_full(self._what):
                async with self._turn:
                    await _to_its_end(partial(_claim, making, claim))
                    await run_helper(
                        self._module,
                        {**request, "folder": str(making), "memory_bytes": self._memory_bytes},
                        what=self._what,
                        timeout_s=TIMEOUT_S,
                        killed=DatasetInvalid,
                    )
                await _to_its_end(partial(self._keep, making, key))
        except UltragrayError as caught:
            error = caught
        except Exception:
            _log.exception(f"{self._what} failed unexpectedly")
            error = UltragrayError(f"{self._what} failed unexpectedly, see the log")
        finally:
            del self._making[key]
            await _to_its_end(claim.close)
        if error is not None and not isinstance(error, DatasetNotFound):  # another name may have the same content
            self._failures[key] = (time.monotonic(), error)
        return error

    def _failure(self, key: str) -> UltragrayError | None:
        """Why it failed, less than a minute ago."""
        now = time.monotonic()
        self._failures = {key: one for key, one in self._failures.items() if now - one[0] < _FAILURE_KEPT_S}
        return self._failures[key][1] if key in self._failures else None

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
        (making / _LOCK_NAME).unlink()
        sync_folder(making)
        try:
            making.rename(self.folder / key)
        except OSError:
            if not (self.folder / key).is_dir():  # else another service was quicker
                raise
        sync_folder(self.folder)
        self._remove_oldest(key)
        self._remove_stale()

    def _remove_oldest(self, newest: str) -> None:
        others = sorted((folder for folder in self._kept() if folder.name != newest), key=_age_s)
        held_bytes = 0
        for count, folder in enumerate(others, 2):
            held_bytes += _size_bytes(folder)
            if count > KEPT_FOLDERS or held_bytes > self._kept_bytes:
                _remove([folder])

    def _remove_stale(self) -> None:
        for folder in self.folder.glob(f"{_PREFIX}*"):
            if _is_abandoned(folder):
                shutil.rmtree(folder, ignore_errors=True)

    def _kept(self) -> list[Path]:
        return [path for path in self.folder.glob("*") if not path.name.startswith(".")]


async def _to_its_end(work: Callable[[], T]) -> T:
    """What `work` returns or raises, in a thread of its own. Who cancels it waits all the same."""
    working = asyncio.ensure_future(in_own_thread(work))
    try:
        return await asyncio.shield(working)
    finally:
        await asyncio.wait({working})


def _claim(making: Path, claim: ExitStack) -> None:
    """Makes the folder, which is locked from the start. What is left of it goes when `claim` is closed."""
    begun = making.with_name(f".claiming-{secrets.token_hex(8)}")
    begun.mkdir(parents=True)
    lock = claim.enter_context((begun / _LOCK_NAME).open("wb"))
    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    begun.rename(making)
    claim.callback(shutil.rmtree, making, ignore_errors=True)


def _is_abandoned(making: Path) -> bool:
    """Whether the service that made it has died."""
    try:
        with (making / _LOCK_NAME).open("rb+") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except FileNotFoundError:
        return _age_s(making) > _FINISHED_WITHIN_S
    except OSError:
        return False
    return True


def _remove(folders: Iterable[Path]) -> None:
    """Each is gone at once, or whole: a service may die while it removes."""
    for folder in folders:
        doomed = folder.with_name(f"{_PREFIX}{secrets.token_hex(8)}")
        with suppress(FileNotFoundError):  # another service was quicker
            folder.rename(doomed)
            shutil.rmtree(doomed, ignore_errors=True)


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
