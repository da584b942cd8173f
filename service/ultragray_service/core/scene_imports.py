"""Scenes that clients send and delete: they lie beside those that jobs make."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import os
import secrets
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import IO

from ultragray.errors import QueueFull, SceneExists, SceneFileInvalid, SceneNotFound, SceneReadOnly, UploadTooLarge
from ultragray.files.atomic import file_sha256
from ultragray.scene_info import SceneHeader, read_header
from ultragray_workers.datasets.incoming import storage_full
from ultragray_workers.datasets.store import sync_folder
from ultragray_workers.jobs.link import link_or_copy
from ultragray_workers.jobs.publication import SCENES_FOLDER
from ultragray_workers.scenes import SUFFIX, SceneStore, check_scene_name

from ..settings import Settings
from ..views.helper_process import run_helper
from .own_thread import in_own_thread

CHECK_TIMEOUT_S = 600.0
MAX_IMPORTS = 4
_PREFIX = ".importing-"
_LOCKED_WITHIN_S = 60.0  # an empty file this young may be about to be locked


class SceneImports:
    """Takes scene files in, whole or not at all, and removes them."""

    def __init__(
        self,
        store: SceneStore,
        settings: Settings,
        maker_of: Callable[[str], Awaitable[str | None]],
        turn: asyncio.Lock,
    ) -> None:
        """`maker_of`: the job that makes a scene, in words; None where none does. Checks wait for `turn`."""
        self._store = store
        self._settings = settings
        self._maker_of = maker_of
        self._turn = turn
        self._folder = settings.artifacts / SCENES_FOLDER
        self._count = 0

    @contextlib.asynccontextmanager
    async def receive(self, name: str, blocks: AsyncIterator[bytes]) -> AsyncIterator[Path]:
        """Writes what arrives into a file, to be given to `accept` within this context; it is removed at the end.

        Raises InvalidArgument for a name that no scene can have, SceneExists, UploadTooLarge, QueueFull, StorageFull.
        """
        check_scene_name(name)
        await self._require_free(name)
        if self._count >= MAX_IMPORTS:
            raise QueueFull(f"{MAX_IMPORTS} scenes are being imported already")
        self._count += 1
        temporary = self._folder / f"{_PREFIX}{secrets.token_hex(8)}"
        try:
            with storage_full("the scene"):
                file = await asyncio.to_thread(self._create, temporary)
                try:
                    await self._write(file, blocks)
                    yield temporary
                finally:
                    await asyncio.to_thread(file.close)
        finally:
            self._count -= 1
            await asyncio.shield(asyncio.to_thread(temporary.unlink, missing_ok=True))

    async def accept(self, received: Path, name: str) -> SceneHeader:
        """Checks a file that was received and serves it as the scene `name`.

        Cancelling it ends the check. Raises SceneFileInvalid, SceneExists, StorageFull, MemoryExceeded,
        DeadlineExceeded.
        """
        async with self._turn:
            await run_helper(
                "helpers.scene_check",
                {"path": str(received), "memory_bytes": self._settings.dataset_memory_mb << 20},
                what="checking the scene",
                timeout_s=CHECK_TIMEOUT_S,
                killed=SceneFileInvalid,
            )
        header = await asyncio.to_thread(read_header, received)
        await self._require_free(name)
        await in_own_thread(lambda: self._publish(received, name))
        return header

    async def delete(self, name: str) -> None:
        """Removes the file of a scene. Raises SceneNotFound, and SceneReadOnly for one of the data folder."""
        await asyncio.to_thread(self._delete, name)

    async def removable(self) -> set[str]:
        """The names of the scenes that `delete` removes."""
        return await asyncio.to_thread(self._store.names_of, self._folder)

    async def remove_stale(self) -> None:
        """Removes what services that died during an import left."""

        def remove() -> None:
            for path in self._folder.glob(f"{_PREFIX}*"):
                with contextlib.suppress(FileNotFoundError):
                    if _is_left(path):
                        path.unlink()

        await asyncio.to_thread(remove)

    async def _write(self, file: IO[bytes], blocks: AsyncIterator[bytes]) -> None:
        received = 0
        async for block in blocks:
            received += len(block)
            if received > self._settings.max_dataset_bytes:
                raise UploadTooLarge(
                    f"a scene file may have at most {self._settings.max_dataset_bytes} bytes", field="body"
                )
            await asyncio.to_thread(file.write, block)
        await in_own_thread(lambda: _finish(file))

    def _create(self, temporary: Path) -> IO[bytes]:
        """The file, locked as long as it is open."""
        self._folder.mkdir(parents=True, exist_ok=True)
        file = temporary.open("xb")
        fcntl.flock(file, fcntl.LOCK_EX)
        return file

    def _publish(self, received: Path, name: str) -> None:
        target = self._folder / f"{name}{SUFFIX}"
        link_or_copy(received, target)
        if not target.samefile(received) and file_sha256(target) != file_sha256(received):  # another one was quicker
            raise self._exists(name)

    async def _require_free(self, name: str) -> None:
        if name in await asyncio.to_thread(self._store.names):
            raise self._exists(name)
        if (maker := await self._maker_of(name)) is not None:
            raise SceneExists(f"{maker} makes a scene {name!r}: choose another name", field="scene")

    def _exists(self, name: str) -> SceneExists:
        is_removable = self._store.file(name).parent == self._folder
        advice = "delete it first, or choose another name" if is_removable else "choose another name"
        return SceneExists(f"there is already a scene {name!r}: {advice}", field="scene")

    def _delete(self, name: str) -> None:
        path = self._store.path(name)
        if path.parent != self._folder:
            raise SceneReadOnly(
                f"the scene {name!r} lies in the data folder of the service: only scenes that were imported, or that "
                "jobs made, can be deleted",
                field="scene",
            )
        try:
            path.unlink()
        except FileNotFoundError:
            raise SceneNotFound(f"there is no scene {name!r} any more", field="scene") from None
        self._store.forget(name)
        sync_folder(self._folder)


def _finish(file: IO[bytes]) -> None:
    file.flush()
    os.fsync(file.fileno())


def _is_left(path: Path) -> bool:
    """Whether a file that was being received belongs to nobody any more."""
    with path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            return False
    status = path.stat()
    return status.st_size > 0 or time.time() - status.st_mtime > _LOCKED_WITHIN_S
