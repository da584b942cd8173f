"""RenderPool: poses in, encoded frames out, rendered by worker processes. Free of torch.

A request becomes a ticket, its poses become parts. Idle workers take parts from the queue, as many as fit one
batch, and write the pixels into the request's memory. A worker that dies, or hangs and is killed, loses nothing:
rendering is pure, so that the parts it had not answered are rendered again by its replacement.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from ultragray.errors import InvalidArgument, RenderFailed
from ultragray.rendering.settings import Resolved
from ultragray.rendering.volumes import SliceView
from ultragray_workers.errors import Draining, NotReady
from ultragray_workers.pool.channel import read_start
from ultragray_workers.pool.dispatcher import Dispatcher
from ultragray_workers.pool.messages import (
    LoadTask,
    PoolConfig,
    Rendered,
    RenderRequest,
    RenderResult,
    S,
    SceneChangedError,
    Search,
    SearchResult,
    UnloadTask,
    reply_bytes,
)
from ultragray_workers.pool.processes import Launcher
from ultragray_workers.pool.waiting import Expiry, Ticket, Turn, WaitingQueue
from ultragray_workers.scene_names import base_name
from ultragray_workers.scenes import SceneStore

logger = logging.getLogger(__name__)

R = TypeVar("R")

MAX_REPLY_BYTES = 2**31 - 2**20
MAX_SCENE_CHANGES = 3
_READ_IN_THREAD_BYTES = 16 * 2**20  # fewer are read within the event loop in some milliseconds at most


@dataclass(frozen=True)
class PoolStatistics:
    waiting_frames: int
    busy: int  # processes at work
    processes_alive: int
    restarts_total: int  # workers that died and were replaced
    kills_total: int  # workers that hung, were killed and replaced
    stuck: int  # processes that have told nothing of their work for some seconds
    pids: tuple[int, ...]  # of the processes that are alive
    renderer: str | None  # of the frame that was rendered last


class RenderPool:
    """Worker processes and the queue before them. All its methods belong to one event loop."""

    def __init__(
        self,
        store: SceneStore,
        config: PoolConfig,
        on_rendered: Callable[[RenderResult[Any]], None] = lambda result: None,
    ) -> None:
        self.on_rendered = on_rendered
        self._store = store
        self._waiting = WaitingQueue(
            config.queue_limit_frames,
            config.max_batch_poses,
            config.client_limit_frames,
            config.max_queue_ms / 1000.0,
        )
        self._launcher = Launcher()
        self._dispatcher = Dispatcher(
            self._launcher,
            config,
            self._waiting,
        )
        self._open: set[Ticket] = set()
        self._renderer: str | None = None
        self._active = 0  # calls of render() under way
        self._all_answered = asyncio.Event()
        self._started = False
        self._draining = False
        self._closed = False

    @property
    def ready(self) -> bool:
        """Whether a frame asked for now would be rendered: a process is alive that is free or gets on with its task."""
        able = any(slot.alive and not slot.stuck for slot in self._dispatcher.slots)
        return self._started and not self._draining and able

    async def start(self) -> None:
        """Returns when every process has rendered its first frame.

        Raises BackendUnavailable, or RenderFailed when the processes do not start; the pool is closed then.
        """
        try:
            await self._dispatcher.start()
        except BaseException:
            await self.close()
            raise
        self._started = True

    async def render(self, request: RenderRequest[S], turn: Turn | None = None) -> RenderResult[S]:
        """Renders the request as soon as its turn comes; cancelling the caller, and its deadline, end the rendering.

        With `turn` its poses can be replaced by newer ones as long as they wait. Raises NotReady, Draining, QueueFull,
        DeadlineExceeded, InvalidArgument, FrameTooCostly, SceneNotFound, SceneFileInvalid, SceneTooLarge,
        MemoryExceeded, RenderFailed; SceneChangedError where the request is for another version of the scene's file.
        """
        result = await self._answered(request, turn or Turn(), _frames)
        self.on_rendered(result)
        return result

    async def search(self, request: RenderRequest[Search]) -> SearchResult[Any]:
        """Looks for a real frame about the pose of the request, or for views; its turn comes, and ends, as that of a
        rendering.

        Raises what `render` raises; InvalidArgument and InvalidImageSize also for pixels that are no frame.
        """
        return await self._answered(request, Turn(), _what_was_found)

    async def _answered(
        self, request: RenderRequest[Any], turn: Turn, read: Callable[[Ticket, Rendered], Awaitable[R]]
    ) -> R:
        """What `read` makes of the answer to a request, while the memory of the answer is there."""
        self._check_accepting()
        self._active += 1
        self._all_answered.clear()
        try:
            for _ in range(MAX_SCENE_CHANGES):
                try:
                    return await self._answer(request, turn, read)
                except SceneChangedError:
                    if request.version is not None:
                        raise
                    if turn.ticket is not None:
                        request = turn.ticket.request  # perhaps with newer poses
            raise RenderFailed(f"scene {request.scene!r} kept changing while it was being rendered", field="scene")
        finally:
            self._active -= 1
            if self._active == 0:
                self._all_answered.set()

    async def load(self, scene: str) -> None:
        """Loads a scene in every process. Raises SceneNotFound, SceneFileInvalid, SceneTooLarge, MemoryExceeded."""
        self._check_accepting()
        name = base_name(scene)
        for _ in range(MAX_SCENE_CHANGES):
            await asyncio.to_thread(self._store.path, scene)
            with self._store.hold(name) as path:
                if path is not None:
                    await self._dispatcher.command_all(LoadTask(name, str(path)))
                    return
        raise RenderFailed(f"scene {scene!r} kept changing while it was being loaded", field="scene")

    async def unload(self, scene: str) -> None:
        """Drops a scene from every process. Raises SceneNotFound for one that neither is held nor exists."""
        self._check_accepting()
        if scene not in self.loaded():
            await asyncio.to_thread(self._store.require, scene)
        await self.forget(scene)

    async def forget(self, scene: str) -> None:
        """Drops a scene that was deleted from every process, also from one that is loading it just now."""
        await self._dispatcher.command_all(UnloadTask(scene))

    def loaded(self) -> dict[str, int]:
        return dict(Counter(name for slot in self._dispatcher.slots for name in slot.resident))

    def statistics(self) -> PoolStatistics:
        return PoolStatistics(
            waiting_frames=self._waiting.frames,
            busy=sum(slot.busy for slot in self._dispatcher.slots),
            processes_alive=sum(slot.alive for slot in self._dispatcher.slots),
            kills_total=sum(slot.kills for slot in self._dispatcher.slots),
            stuck=sum(slot.stuck for slot in self._dispatcher.slots),
            restarts_total=sum(slot.replacements for slot in self._dispatcher.slots),
            pids=tuple(slot.pid for slot in self._dispatcher.slots if slot.pid is not None),
            renderer=self._renderer,
        )

    async def drain(self, timeout_s: float) -> None:
        """Refuses new requests and returns when all earlier ones are answered, or after the timeout."""
        self._draining = True
        if self._active:
            try:
                await asyncio.wait_for(self._all_answered.wait(), timeout_s)
            except asyncio.TimeoutError:
                logger.warning("%d requests were not answered within %g s of draining", self._active, timeout_s)

    async def close(self) -> None:
        """Ends all processes, and requests that are still open with Draining."""
        self._draining = True
        self._closed = True
        for ticket in list(self._open):
            self._waiting.remove(ticket)
            ticket.fail(Draining("the service is stopping"))
        self._launcher.abandon_starting()
        await self._dispatcher.close()
        await self._launcher.close()
        if self._active:
            await self._all_answered.wait()

    def _check_accepting(self) -> None:
        if self._draining:
            raise Draining("the service is stopping; it takes no new requests")
        if not self._started:
            raise NotReady("the service is starting; try again in a few seconds")

    async def _answer(
        self, request: RenderRequest[Any], turn: Turn, read: Callable[[Ticket, Rendered], Awaitable[R]]
    ) -> R:
        with self._store.hold(request.scene) as path:
            if path is None:
                await asyncio.to_thread(self._store.path, request.scene)  # fetches it, or raises that there is none
                raise SceneChangedError
            turn.ticket = ticket = self._ticket(request, path)
            turn.expiry = Expiry(ticket, self._waiting)
            try:
                self._open.add(ticket)
                self._dispatcher.submit(ticket)
                rendered = await ticket.done
                self._renderer = rendered.renderer
                return await read(ticket, rendered)
            finally:
                turn.expiry.cancel()
                self._open.discard(ticket)
                self._dispatcher.discard(ticket)

    def _ticket(self, request: RenderRequest[Any], path: Path) -> Ticket:
        """Raises InvalidArgument for a request that no reply can hold."""
        if not len(request.poses):
            raise InvalidArgument("poses must hold at least one pose, got none", field="poses")
        if not isinstance(request.settings, Search):
            _check_reply(request.settings, len(request.poses))
        return Ticket(
            request=request,
            path=str(path),
            done=asyncio.get_running_loop().create_future(),
            submitted=time.monotonic(),
        )


def _check_reply(settings: Resolved | SliceView, poses: int) -> None:
    """Raises InvalidArgument for what no reply can hold."""
    if settings.encoding.is_image_file and poses != 1:
        raise InvalidArgument(
            f"encoding {settings.encoding.value} holds the frame of one pose, got {poses} poses", field="encoding"
        )
    if (size := reply_bytes(settings, poses)) > MAX_REPLY_BYTES:
        raise InvalidArgument(
            f"poses times pixels must fit a reply of {MAX_REPLY_BYTES} bytes, got {size}",
            field="poses",
        )


async def _frames(ticket: Ticket, rendered: Rendered) -> RenderResult[Any]:
    request, place = ticket.request, ticket.hand_over()
    data = b"" if place is not None else await _read(ticket.reply_memory, rendered.size)
    return RenderResult(
        scene=request.scene,
        scene_sha256=rendered.scene_sha256,
        renderer=rendered.renderer,
        settings=request.settings,
        poses=request.poses,
        data=data,
        queue_ms=_queue_ms(ticket, rendered),
        render_ms=rendered.render_ms,
        encode_ms=rendered.encode_ms,
        extrapolations=rendered.extrapolations,
        batch_size=ticket.batch_size,
        place=None if place is None else replace(place, size=rendered.size),
    )


async def _what_was_found(ticket: Ticket, rendered: Rendered) -> SearchResult[Any]:
    return SearchResult(
        scene=ticket.request.scene,
        scene_sha256=rendered.scene_sha256,
        renderer=rendered.renderer,
        found=rendered.found,
        queue_ms=_queue_ms(ticket, rendered),
        search_ms=rendered.render_ms,
    )


def _queue_ms(ticket: Ticket, rendered: Rendered) -> float:
    return max(0.0, rendered.started - ticket.submitted) * 1000.0


async def _read(memory: int, size: int) -> bytes:
    """The first `size` bytes of a file; many of them in a thread."""
    if size > _READ_IN_THREAD_BYTES:
        return await asyncio.to_thread(read_start, memory, size)
    return read_start(memory, size)
