"""Scenes that clients send and delete: they lie beside those that jobs make."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable
from functools import partial
from pathlib import Path

from ultragray.errors import SceneFileInvalid
from ultragray.files.atomic import sync
from ultragray.scene_info import SceneHeader, read_header
from ultragray_service.access.limits.holdings import Holdings
from ultragray_service.access.limits.slots import Slots
from ultragray_service.access.owners import Claim, Owners
from ultragray_service.core.helper_processes import HelperProcesses
from ultragray_service.core.own_thread import in_own_thread, to_its_end
from ultragray_service.errors import SceneReadOnly
from ultragray_service.settings import Settings
from ultragray_workers.claims import storage_full
from ultragray_workers.errors import SceneExists, SceneNotFound, UploadTooLarge
from ultragray_workers.jobs.queue.owners import Kind
from ultragray_workers.scene_names import SUFFIX, check_scene_name
from ultragray_workers.scenes import SceneStore, check_scene_file
from ultragray_workers.shelves.shelf import Shelf

CHECK_TIMEOUT_S = 600.0
MAX_IMPORTS = 4


class SceneImports:
    """Takes scene files in, whole or not at all, and removes them."""

    def __init__(
        self,
        store: SceneStore,
        shelf: Shelf,
        settings: Settings,
        maker_of: Callable[[str], Awaitable[str | None]],
        checks: HelperProcesses,
        owners: Owners,
        holdings: Holdings,
    ) -> None:
        """`shelf`: of the store, for what is imported; `maker_of`: the job that makes a scene, in words; or None."""
        self._store = store
        self._settings = settings
        self._maker_of = maker_of
        self._checks = checks
        self._owners = owners
        self._holdings = holdings
        self._shelf = shelf
        self._slots = Slots(MAX_IMPORTS, "imports of scenes")

    @contextlib.asynccontextmanager
    async def receive(self, name: str, blocks: AsyncIterator[bytes]) -> AsyncIterator[Path]:
        """Writes what arrives into a file, to be given to `accept` within this context; it is removed at the end.

        Raises InvalidArgument for a name that no scene can have, SceneExists, UploadTooLarge, QueueFull, LimitReached,
        StorageFull.
        """
        check_scene_name(name)
        await self._require_free(name)
        with self._slots.one():
            claim = contextlib.ExitStack()
            try:
                room, most = await self._holdings.room(), self._settings.max_dataset_bytes
                with storage_full("the scene"), room.to_blame(most):
                    folder = await to_its_end(lambda: claim.enter_context(self._shelf.making()))
                    received = folder / f"{name}{SUFFIX}"
                    await self._write(received, blocks, room.at_most(most))
                    yield received
            finally:
                await to_its_end(claim.close)

    async def accept(self, received: Path, name: str, *, private: bool) -> SceneHeader:
        """Checks a file that was received and serves it as the scene `name`.

        Cancelling it ends the check. Raises SceneFileInvalid, SceneExists, StorageFull, MemoryExceeded,
        DeadlineExceeded.
        """
        await self._require_free(name)
        claim = Claim(self._owners, Kind.SCENE, name, received.parent.name, private=private)
        async with claim.held():
            if not await claim.take(partial(self._is_there, name)):
                await self._require_free(name)
                raise SceneExists(f"another import makes a scene {name!r}: choose another name", field="scene")
            await self._checks.run(
                check_scene_file,
                {"path": str(received)},
                what="checking the scene",
                timeout_s=CHECK_TIMEOUT_S,
                killed=SceneFileInvalid,
            )
            header = await asyncio.to_thread(read_header, received)
            await self._require_free(name)
            await claim.spread()
            await to_its_end(lambda: self._publish(received, name, claim))
        return header

    async def delete(self, name: str) -> None:
        """Removes the file of a scene. Raises SceneNotFound, and SceneReadOnly for one of the data folder."""
        async with self._owners.removing(Kind.SCENE, name):
            await asyncio.to_thread(self._delete, name)

    async def removable(self) -> set[str]:
        """The names of the scenes that `delete` removes."""
        return await asyncio.to_thread(self._store.names_of, self._shelf)

    async def remove_stale(self) -> None:
        """Removes what services that died during an import left."""

        await asyncio.to_thread(self._shelf.remove_abandoned)

    async def _write(self, path: Path, blocks: AsyncIterator[bytes], max_bytes: int) -> None:
        received = 0
        with path.open("xb") as file:
            async for block in blocks:
                received += len(block)
                if received > max_bytes:
                    raise UploadTooLarge(f"a scene file may have at most {max_bytes} bytes", field="body")
                await asyncio.to_thread(file.write, block)
            await asyncio.to_thread(file.flush)
        await in_own_thread(lambda: sync(path))

    def _publish(self, received: Path, name: str, claim: Claim) -> None:
        try:
            self._shelf.publish(received, name)
        except SceneExists:  # another one was quicker
            raise self._exists(name) from None
        claim.is_made = True

    async def _is_there(self, name: str, claim: str | None) -> bool:
        """Whether the scene of a claim is there, or is being made: in this order it is not missed."""
        if claim is not None and await asyncio.to_thread(self._shelf.is_making, claim):
            return True
        if await self._maker_of(name) is not None:
            return True
        return await asyncio.to_thread(self._store.shelf_of, name) is not None

    async def _require_free(self, name: str) -> None:
        if await asyncio.to_thread(self._store.shelf_of, name) is not None:
            raise await asyncio.to_thread(self._exists, name)
        if (maker := await self._maker_of(name)) is not None:
            raise SceneExists(f"{maker} makes a scene {name!r}: choose another name", field="scene")

    def _exists(self, name: str) -> SceneExists:
        is_removable = self._store.shelf_of(name) is self._shelf
        advice = "delete it first, or choose another name" if is_removable else "choose another name"
        return SceneExists(f"there is already a scene {name!r}: {advice}", field="scene")

    def _delete(self, name: str) -> None:
        check_scene_name(name)
        self._store.require(name)
        if self._store.shelf_of(name) is not self._shelf:
            raise SceneReadOnly(
                f"the scene {name!r} lies in the data folder of the service: only scenes that were imported, or that "
                "jobs made, can be deleted",
                field="scene",
            )
        if not self._shelf.remove(name):
            raise SceneNotFound(f"there is no scene {name!r} any more", field="scene")
        self._store.forget(name)
