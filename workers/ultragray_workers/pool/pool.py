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
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from ultragray.errors import InvalidArgument, RenderFailed
from ultragray.geometry.probe import FloatArray
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
from ultragray_workers.pool.waiting import Deadlines, Ticket, WaitingQueue
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


class Turn:
    """A request's place in the queue, which newer poses may take while it waits. A context manager, which closes it."""

    def __init__(self, pool: RenderPool, request: RenderRequest[Any]) -> None:
        self.request = request  # with the newest poses
        self.ticket: Ticket | None = None  # None while the file of its scene is not on this host
        self.hold: AbstractContextManager[Path] | None = None  # that file
        self.is_awaited = False  # somebody waits for the answer
        self._pool = pool

    @property
    def is_rendered(self) -> bool:
        """Whether there is an answer, which somebody may yet have to take."""
        return self.ticket is not None and self.ticket.done.done()

    def give_to(self, poses: FloatArray, deadline: float | None) -> bool:  # [C, 4, 4] mm
        """Has other poses rendered in place of those that wait, as many of them; False where that is too late."""
        ticket = self.ticket
        if ticket is None or not ticket.untouched:
            return False
        assert len(poses) == len(self.request.poses)
        self.request = ticket.request = replace(self.request, poses=poses, deadline=deadline)
        ticket.submitted = time.monotonic()
        self._pool.deadlines.watch(ticket)
        return True

    def close(self) -> None:
        """Ends the rendering, unless it is done, and gives back what it took."""
        self._pool.close_turn(self)

    def __enter__(self) -> Turn:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


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
        self.deadlines = Deadlines(self._waiting)
        self._turns: set[Turn] = set()  # that are not closed
        self._renderer: str | None = None
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

    async def render(self, request: RenderRequest[S]) -> RenderResult[S]:
        """Renders the request as soon as its turn comes; cancelling the caller, and its deadline, end the rendering.

        Raises NotReady, Draining, QueueFull, DeadlineExceeded, InvalidArgument, FrameTooCostly, SceneNotFound,
        SceneFileInvalid, SceneTooLarge, MemoryExceeded, RenderFailed; SceneChangedError where the request is for
        another version of the scene's file.
        """
        with self.ask(request) as turn:
            return await self.frames(turn)

    async def search(self, request: RenderRequest[Search]) -> SearchResult[Any]:
        """Looks for a real frame about the pose of the request, or for views; its turn comes, and ends, as that of a
        rendering.

        Raises what `render` raises; InvalidArgument and InvalidImageSize also for pixels that are no frame.
        """
        with self.ask(request) as turn:
            return await self._answer(turn, _search_result)

    def ask(self, request: RenderRequest[Any]) -> Turn:
        """Puts a request into the queue at once; the caller closes its turn, answered or not.

        Raises NotReady, Draining, QueueFull, InvalidArgument.
        """
        self._check_accepting()
        turn = Turn(self, request)
        self._turns.add(turn)
        try:
            self._queue(turn)
        except BaseException:
            turn.close()
            raise
        return turn

    async def frames(self, turn: Turn) -> RenderResult[Any]:
        """Waits for the frames of a turn, once. Raises what `render` raises."""
        result = await self._answer(turn, _frames)
        asyncio.get_running_loop().call_soon(self.on_rendered, result)  # the caller has its frame first
        return result

    async def _answer(self, turn: Turn, read: Callable[[Ticket, Rendered], Awaitable[R]]) -> R:
        """What `read` makes of the answer to a request, while the memory of the answer is there."""
        turn.is_awaited = True
        try:
            for _ in range(MAX_SCENE_CHANGES):
                try:
                    if turn.ticket is None:  # fetches the file of the scene, or raises that there is none
                        await asyncio.to_thread(self._store.path, turn.request.scene)
                        raise SceneChangedError
                    rendered = await turn.ticket.done
                    self._renderer = rendered.renderer
                    return await read(turn.ticket, rendered)
                except SceneChangedError:
                    if turn.request.version is not None:
                        raise
                    self._leave(turn)
                    self._queue(turn)
        finally:
            turn.is_awaited = False
            self._tell_if_answered()
        raise RenderFailed(f"scene {turn.request.scene!r} kept changing while it was being rendered", field="scene")

    def _queue(self, turn: Turn) -> None:
        """Makes a ticket for a turn, unless the file of its scene is not on this host now."""
        if self._closed:
            raise Draining("the service is stopping")
        if (hold := self._store.hold(turn.request.scene)) is None:
            return
        turn.hold = hold
        turn.ticket = ticket = _ticket(turn.request, hold.__enter__())
        self.deadlines.watch(ticket)
        if self._draining:
            ticket.done.add_done_callback(self._tell_if_answered)
        self._dispatcher.submit(ticket)

    def close_turn(self, turn: Turn) -> None:
        self._leave(turn)
        self._turns.discard(turn)
        self._tell_if_answered()

    def _leave(self, turn: Turn) -> None:
        ticket, turn.ticket = turn.ticket, None
        if ticket is not None:
            self.deadlines.forget(ticket)
            ticket.done.cancel()  # or, where it has failed, nobody need have asked why
            self._dispatcher.discard(ticket)
        hold, turn.hold = turn.hold, None
        if hold is not None:
            hold.__exit__(None, None, None)

    async def load(self, scene: str) -> None:
        """Loads a scene in every process. Raises SceneNotFound, SceneFileInvalid, SceneTooLarge, MemoryExceeded."""
        self._check_accepting()
        name = base_name(scene)
        for _ in range(MAX_SCENE_CHANGES):
            await asyncio.to_thread(self._store.path, scene)
            if (hold := self._store.hold(name)) is not None:
                with hold as path:
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
        """Refuses new requests and returns when all earlier ones are answered, or after the timeout.

        An answer counts that nobody takes: the client of a stream may have stopped reading.
        """
        self._draining = True
        for turn in self._turns:
            if turn.ticket is not None:
                turn.ticket.done.add_done_callback(self._tell_if_answered)
        self._tell_if_answered()
        if not self._all_answered.is_set():
            try:
                await asyncio.wait_for(self._all_answered.wait(), timeout_s)
            except asyncio.TimeoutError:
                count = sum(map(self._is_unanswered, self._turns))
                logger.warning("%d requests were not answered within %g s of draining", count, timeout_s)

    async def close(self) -> None:
        """Ends all processes, and requests that are still open with Draining."""
        self._draining = True
        self._closed = True
        for turn in self._turns:
            if turn.ticket is not None:
                self._waiting.remove(turn.ticket)
                turn.ticket.fail(Draining("the service is stopping"))
        self._launcher.abandon_starting()
        await self._dispatcher.close()
        await self._launcher.close()
        self._all_answered.clear()
        self._tell_if_answered()
        await self._all_answered.wait()
        self.deadlines.close()

    def _is_unanswered(self, turn: Turn) -> bool:
        return turn.is_awaited or not (self._closed or turn.is_rendered)

    def _tell_if_answered(self, _: object = None) -> None:
        if self._draining and not any(map(self._is_unanswered, self._turns)):
            self._all_answered.set()

    def _check_accepting(self) -> None:
        if self._draining:
            raise Draining("the service is stopping; it takes no new requests")
        if not self._started:
            raise NotReady("the service is starting; try again in a few seconds")


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


def _ticket(request: RenderRequest[Any], path: Path) -> Ticket:
    """Raises InvalidArgument for a request that no reply can hold."""
    if not len(request.poses):
        raise InvalidArgument("poses must hold at least one pose, got none", field="poses")
    if not isinstance(request.settings, Search):
        _check_reply(request.settings, len(request.poses))
    return Ticket(request, str(path), asyncio.get_running_loop().create_future(), submitted=time.monotonic())


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


async def _search_result(ticket: Ticket, rendered: Rendered) -> SearchResult[Any]:
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
