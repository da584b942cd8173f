"""Scenes that clients send and delete: they lie beside those that jobs make."""

from __future__ import annotations

import asyncio
import contextlib
import os
import secrets
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import IO

from ultragray.errors import QueueFull, SceneExists, SceneFileInvalid, SceneNotFound, SceneReadOnly, UploadTooLarge
from ultragray.files import file_sha256
from ultragray.scene_info import SceneHeader, read_header
from ultragray_workers.dataset_incoming import storage_full
from ultragray_workers.dataset_store import sync_folder
from ultragray_workers.jobs.link import link_or_copy
from ultragray_workers.jobs.publication import SCENES_FOLDER
from ultragray_workers.scenes import SUFFIX, SceneStore, check_scene_name

from .helper_process import run_helper
from .settings import Settings

CHECK_TIMEOUT_S = 600.0
MAX_IMPORTS = 4
_PREFIX = ".importing-"
_STALE_S = 3600.0


class SceneImports:
    """Takes scene files in, whole or not at all, and removes them."""

    def __init__(self, store: SceneStore, settings: Settings, maker_of: Callable[[str], str | None]) -> None:
        """`maker_of`: the job that makes a scene, in words; None where none does."""
        self._store = store
        self._settings = settings
        self._maker_of = maker_of
        self._folder = settings.artifacts / SCENES_FOLDER
        self._count = 0

    async def take_in(self, name: str, blocks: AsyncIterator[bytes]) -> SceneHeader:
        """Writes what arrives, checks it and serves it as the scene `name`.

        Raises InvalidArgument for a name that no scene can have, SceneExists, SceneFileInvalid, UploadTooLarge,
        QueueFull, StorageFull, MemoryExceeded, DeadlineExceeded.
        """
        check_scene_name(name)
        await asyncio.to_thread(self._require_free, name)
        if self._count >= MAX_IMPORTS:
            raise QueueFull(f"{MAX_IMPORTS} scenes are being imported already")
        self._count += 1
        temporary = self._folder / f"{_PREFIX}{secrets.token_hex(8)}"
        try:
            with storage_full("the scene"):
                await self._write(temporary, blocks)
            return await self._accept(temporary, name)
        finally:
            self._count -= 1
            await asyncio.shield(asyncio.to_thread(temporary.unlink, missing_ok=True))

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
                    if time.time() - path.stat().st_mtime > _STALE_S:
                        path.unlink()

        await asyncio.to_thread(remove)

    async def _write(self, temporary: Path, blocks: AsyncIterator[bytes]) -> None:
        file = await asyncio.to_thread(self._create, temporary)
        received = 0
        try:
            async for block in blocks:
                received += len(block)
                if received > self._settings.max_dataset_bytes:
                    raise UploadTooLarge(
                        f"a scene file may have at most {self._settings.max_dataset_bytes} bytes", field="body"
                    )
                await asyncio.to_thread(file.write, block)
            await asyncio.to_thread(_finish, file)
        finally:
            await asyncio.to_thread(file.close)

    def _create(self, temporary: Path) -> IO[bytes]:
        self._folder.mkdir(parents=True, exist_ok=True)
        return temporary.open("xb")

    async def _accept(self, temporary: Path, name: str) -> SceneHeader:
        header = await asyncio.to_thread(_header, temporary)
        await run_helper(
            "scene_check",
            {"path": str(temporary), "memory_bytes": self._settings.dataset_memory_mb << 20},
            what="checking the scene",
            timeout_s=CHECK_TIMEOUT_S,
            killed=SceneFileInvalid,
        )
        await asyncio.to_thread(self._publish, temporary, name)
        return header

    def _publish(self, temporary: Path, name: str) -> None:
        self._require_free(name)
        target = self._folder / f"{name}{SUFFIX}"
        link_or_copy(temporary, target)
        if file_sha256(target) != file_sha256(temporary):  # another one was quicker
            raise self._exists(name)

    def _require_free(self, name: str) -> None:
        if name in self._store.names():
            raise self._exists(name)
        if (maker := self._maker_of(name)) is not None:
            raise SceneExists(f"{maker} makes a scene {name!r}: choose another name", field="scene")

    def _exists(self, name: str) -> SceneExists:
        return SceneExists(f"there is already a scene {name!r}: delete it first, or choose another name", field="scene")

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
        sync_folder(self._folder)


def _finish(file: IO[bytes]) -> None:
    file.flush()
    os.fsync(file.fileno())


def _header(temporary: Path) -> SceneHeader:
    try:
        return read_header(temporary)
    except SceneFileInvalid as error:
        raise SceneFileInvalid(error.detail.replace(str(temporary), "the body"), field="body") from error
