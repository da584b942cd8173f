"""The worker process: takes tasks from its channel one at a time, renders, encodes, answers. Imports torch.

`_Worker._done` finds the work of a task by the kind of its settings: frames, slices, a frame that is looked for.
Each part of a task has an answer of its own, as soon as its pixels lie in the memory of its request.
"""

from __future__ import annotations

import logging
import mmap
import os
import select
import signal
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from ultragray.errors import MemoryExceeded, RenderFailed, SceneFileInvalid, UltragrayError
from ultragray.files import file_sha256
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.learn.localization.pixels import read_grey, read_png
from ultragray.learn.localization.search import localize
from ultragray.learn.planning.search import plan_views
from ultragray.rendering.backends import cuda
from ultragray.rendering.backends.registry import render_device, renderer_name
from ultragray.rendering.confidence import SupportWatch
from ultragray.rendering.frames import render_shown
from ultragray.rendering.limits import UNLIMITED, GivenUp, Limits
from ultragray.rendering.pixels import encoded_image, in_type
from ultragray.rendering.settings import Encoding, Resolved
from ultragray.rendering.volume_fields import sample_slice
from ultragray.rendering.volumes import LESS_FOR_A_PIECE, SliceView
from ultragray.scene.confidence import Assessor, require_confidence
from ultragray.scene.gaussians import GaussianScene
from ultragray.scene.info import read_header, scene_file_invalid
from ultragray_workers.errors import DeadlineExceeded, SceneTooLarge
from ultragray_workers.pool.channel import Board, Channel, read_start, write_at
from ultragray_workers.pool.messages import (
    Answer,
    AnyTask,
    ForkWorker,
    Hello,
    Loading,
    LoadTask,
    NextViews,
    Outcome,
    PackTask,
    Rendered,
    SceneChangedError,
    Sought,
    Task,
    TaskPart,
    UnloadTask,
)
from ultragray_workers.pool.pixels import CHUNK_POSES, Arriving, Wanted, render_to_host, write_npz
from ultragray_workers.scenes import resident_bytes
from ultragray_workers.storage.local import FileVersion

MAX_DETAIL_LENGTH = 2000

logger = logging.getLogger(__name__)


def run_worker(channel: Channel, settings: ForkWorker, board_memory: int) -> None:
    """Serves the channel until the service hangs up or dies."""
    board = Board(board_memory)
    os.close(board_memory)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    threading.Thread(target=_exit_with_service, args=(channel.fileno(),), daemon=True).start()
    torch.set_grad_enabled(False)
    try:
        worker = _Worker(channel, settings, board)
        worker.warm_up()
    except Exception as error:
        channel.send(Hello(os.getpid(), error=_as_reported(error)))
        return
    channel.send(Hello(os.getpid(), gpus=worker.gpus))
    while True:
        try:
            task, descriptors = channel.receive()
        except (EOFError, ConnectionError):
            return
        worker.do(task, descriptors)


def _exit_with_service(channel_descriptor: int) -> None:
    """Ends this process, in the middle of a frame if need be, when the service hangs up or dies."""
    poll = select.poll()
    poll.register(channel_descriptor, select.POLLRDHUP)
    poll.poll()
    os._exit(0)


class _Worker:
    def __init__(self, channel: Channel, settings: ForkWorker, board: Board) -> None:
        self._channel = channel
        self._board = board
        self._tasks = 0  # taken up
        config = settings.pool
        self._max_footprint_pixels, self._backend = config.max_footprint_pixels, config.backend
        self._device = render_device(config.backend, settings.number)
        self.gpus = cuda.device_count() if self._device.type == "cuda" else 0
        if self.gpus:
            torch.cuda.set_device(self._device)  # kernels are launched on the current one
        processes = config.processes or max(1, self.gpus)
        torch.set_num_threads(config.threads_per_process or max(1, len(os.sched_getaffinity(0)) // processes))
        self._scenes = SceneCache(config.memory_budget_bytes, self._device)

    def warm_up(self) -> None:
        """Renders and encodes small frames, so that the first request does not pay for first uses."""
        shapes = {"means": (1, 3), "scales": (1, 3), "transmittances": (1,), "sh0": (1, 1, 1)}
        splats = {name: torch.zeros(shape) for name, shape in shapes.items()} | {"quats": torch.ones(1, 4)}
        self._render_small(GaussianScene.from_splats(splats).to(self._device))

    def _render_small(self, scene: GaussianScene) -> None:
        """Renders and encodes a frame for each bundle of scan lines, as kernels differ by it."""
        pixel_type = Encoding.PNG.pixel_type
        for probe in example_probes():
            frames = self._render(scene, Resolved(probe, 16, 16), np.eye(4)[None], {"bmode": {pixel_type}})
            encoded_image(frames.take("bmode", pixel_type, 0, 1)[0], Encoding.PNG)

    def do(self, task: AnyTask, memories: list[int]) -> None:
        """Does one task and answers each of its parts, whatever happens."""
        self._tasks += 1
        self._board.taken[0] = self._tasks
        try:
            if isinstance(task, Task):
                for part, outcome in enumerate(self._done(task, memories)):
                    self._answer(part, outcome, last=part == len(task.parts) - 1)
            else:
                self._answer(0, _outcome(lambda: self._do_other(task, memories)), last=True)
        finally:
            for memory in memories:
                os.close(memory)

    def _done(self, task: Task[Any], memories: Sequence[int]) -> Iterator[Outcome]:
        """The outcomes of a task's parts: frames are rendered together, all else is done part by part."""
        if isinstance(task.view, Resolved):
            yield from self._render_parts(task, memories)
            return
        work = partial(self._WORK[type(task.view)], self, task)
        for part, memory in zip(task.parts, memories, strict=True):
            yield _outcome(partial(work, part, memory))

    def _answer(self, part: int, outcome: Outcome, *, last: bool) -> None:
        self._channel.send(Answer(part=part, outcome=outcome, last=last, resident=self._scenes.names()))

    def _do_other(self, task: PackTask | LoadTask | UnloadTask, memories: list[int]) -> Rendered | None:
        match task:
            case PackTask():
                return _pack(task, *memories)
            case LoadTask():
                self._loaded(task.scene, task.path)
            case UnloadTask():
                self._scenes.drop(task.scene)
        return None

    def _loaded(self, name: str, path: str) -> LoadedScene:
        """A scene, ready for its first frame. Raises SceneFileInvalid, SceneTooLarge, MemoryExceeded."""
        if (scene := self._scenes.held(name, path)) is not None:
            return scene
        self._channel.send(Loading(begins=True))
        try:
            loaded = self._scenes.get(name, path)
            self._render_small(loaded.scene)  # lets the kernels prepare it
        finally:
            self._channel.send(Loading(begins=False))
        return loaded

    def _scene_of(self, task: Task[Any]) -> LoadedScene:
        """The scene of a task. Raises what `_loaded` raises, and SceneChangedError for one of another version."""
        loaded = self._loaded(task.scene, task.path)
        if task.version not in (None, loaded.version):
            raise SceneChangedError
        return loaded

    def _limits(self, name_pose: Callable[[int], str]) -> Limits:
        """The limits of the task at hand, which the service may have given up meanwhile."""
        return Limits(self._max_footprint_pixels, self._board.given_up, self._tasks, name_pose)

    def _rendered(self, loaded: LoadedScene, started: float, **more: Any) -> Rendered:
        """The report on what was rendered, or looked for, since `started`."""
        return Rendered(
            **{"size": 0, "encode_ms": 0.0, **more},
            scene_sha256=loaded.sha256,
            renderer=renderer_name(self._backend, loaded.scene),
            started=started,
            render_ms=_since_ms(started),
        )

    def _render_parts(self, task: Task[Resolved], memories: Sequence[int]) -> Iterator[Outcome]:
        """Frames: all parts are rendered together, where that fails each alone, as it may be one that fails."""
        first = task.parts[0]
        poses = (
            first.poses if len(task.parts) == 1 else np.concatenate([part.poses for part in task.parts])
        )  # [C, 4, 4]
        wanted: dict[str, set[np.dtype[Any]]] = {}
        for part in task.parts:
            for name in part.settings.outputs:
                wanted.setdefault(name, set()).add(part.settings.encoding.pixel_type)
        try:
            loaded = self._scene_of(task)
            extrapolations = loaded.assessor.assess(poses, task.view.probe, phase=task.view.phase)
        except SceneChangedError as error:
            yield from [error] * len(task.parts)
            return
        except Exception as error:
            yield from [_as_reported(error)] * len(task.parts)
            return
        frames = None
        try:
            require_confidence(extrapolations, task.view.least_confidence, name_pose=first.name_pose)
            support = SupportWatch(loaded.assessor, extrapolations, task.view)
            started = time.monotonic()
            frames = self._render(loaded.scene, task.view, poses, wanted, support, self._limits(first.name_pose))
            rendered = self._rendered(loaded, started)
        except GivenUp:
            yield from [_GIVEN_UP] * len(task.parts)
            return
        except Exception as error:
            if len(task.parts) == 1:
                yield _as_reported(error)
                return
        if frames is None:  # out of the handler: the error holds on to memory of the GPU
            for part, memory in zip(task.parts, memories, strict=True):
                yield from self._render_parts(replace(task, parts=(part,)), [memory])
            return
        begin = 0
        for part, memory in zip(task.parts, memories, strict=True):
            end = begin + len(part.poses)
            yield _outcome(partial(_write_part, part, frames, begin, memory, rendered, support))
            begin = end

    def _render(
        self,
        scene: GaussianScene,
        view: Resolved,
        poses: FloatArray,  # [C, 4, 4] mm
        wanted: Wanted,
        support: SupportWatch | None = None,
        limits: Limits = UNLIMITED,
    ) -> Arriving:
        outputs = tuple(wanted)
        in_bytes = set().union(*wanted.values()) == {Encoding.UINT8.pixel_type}
        done = 0

        def render(some: FloatArray) -> dict[str, Tensor]:  # [C, 4, 4] -> each [C, H, W] of the picture
            nonlocal done
            done += len(some)
            return render_shown(
                scene,
                view,
                some,
                outputs=outputs,
                backend=self._backend,
                limits=limits if done == len(some) else limits.after(done - len(some)),
                support=support,
                in_bytes=in_bytes,
            )

        try:
            return render_to_host(render, poses, wanted, self._device)
        except torch.OutOfMemoryError as error:
            raise MemoryExceeded(
                f"{len(poses)} frames of {view.height}x{view.width} pixels ({', '.join(outputs)}) do not fit into the "
                f"free memory of {self._device}; ask for fewer or smaller ones"
            ) from error

    def _sample(self, task: Task[SliceView], part: TaskPart[SliceView], memory: int) -> Rendered:
        loaded, view = self._scene_of(task), part.settings
        started, size = time.monotonic(), 0
        limits = replace(
            self._limits(lambda _: "spacing_mm"), footprint_pixels=self._max_footprint_pixels // LESS_FOR_A_PIECE
        )
        for number, pose in enumerate(part.poses, part.first):
            pixels = sample_slice(loaded.scene, view.field, view.grid(pose), limits)
            data = np.ascontiguousarray(pixels, pixels.dtype.newbyteorder("<"))
            write_at(memory, data.data.cast("B"), number * data.nbytes)
            size = part.total * data.nbytes
        return self._rendered(loaded, started, size=size, first=part.first)

    def _search(self, task: Task[Sought], part: TaskPart[Sought], memory: int) -> Rendered:
        loaded, settings = self._scene_of(task), part.settings.settings
        started, size = time.monotonic(), part.settings.size
        data = read_start(memory, os.fstat(memory).st_size)
        match = localize(
            loaded.scene,
            read_png(data) if size is None else read_grey(data, *size),
            part.poses[0],
            probe=settings.probe,
            within_mm=settings.within_mm,
            within_deg=settings.within_deg,
            search=settings.search,
            backend=self._backend,
            limits=self._limits(lambda _: "start"),
        )
        return self._rendered(loaded, started, found=match)

    def _plan(self, task: Task[NextViews], part: TaskPart[NextViews], memory: int) -> Rendered:
        loaded, request = self._scene_of(task), part.settings
        started = time.monotonic()
        reach = np.frombuffer(read_start(memory, os.fstat(memory).st_size)).reshape(-1, 4, 4)
        view_plan = plan_views(
            loaded.scene,
            request.settings,
            poses=reach if len(reach) else None,
            view=request.standard_plane,
            start=request.start,
            limits=self._limits(lambda _: "poses"),
        )
        return self._rendered(loaded, started, found=view_plan)

    _WORK: ClassVar[dict[type, Callable[..., Rendered]]] = {SliceView: _sample, Sought: _search, NextViews: _plan}


def example_probes() -> tuple[Probe, ...]:
    """One probe for each bundle of scan lines that probes have."""
    examples: list[Probe] = [member(**member.example()) for member in Probe.members.values()]
    return tuple({type(probe.lines): probe for probe in examples}.values())


def _write_part(
    part: TaskPart,
    frames: Arriving,  # of a batch that holds the part from its pose `begin` on
    begin: int,
    memory: int,
    rendered: Rendered,  # the batch
    support: SupportWatch,
) -> Rendered:
    """Encodes a part into its request's memory: an image file, or its share of the pixels, output after output.

    An .npz is made of these when all parts are there (`_pack`). Raises DeadlineExceeded where nobody waits any more,
    LowConfidence for a frame that has, once it is rendered, less than the least confidence.
    """
    if part.deadline is not None and time.monotonic() >= part.deadline:
        raise DeadlineExceeded("the deadline passed before the frames were written")
    outputs, encoding, end = part.settings.outputs, part.settings.encoding, begin + len(part.poses)
    least = part.settings.least_confidence
    if least is not None:
        require_confidence(support.completed(begin, end), least, name_pose=part.name_pose)
    started, waited_ms = time.monotonic(), frames.waited_ms
    pixel_type = encoding.pixel_type
    if encoding.is_image_file:
        image = encoded_image(frames.take(outputs[0], pixel_type, begin, end)[0], encoding)
        size = len(image)
        if part.room is not None and size > part.room:
            raise RenderFailed(f"the image file has {size} bytes, {part.room} were expected at most")
        write_at(memory, memoryview(image), part.offset)
    else:
        for first in range(begin, end, CHUNK_POSES):  # each is written while the next one arrives
            for number, name in enumerate(outputs):
                pixels = in_type(frames.take(name, pixel_type, first, min(first + CHUNK_POSES, end)), pixel_type)
                place = number * part.total + part.first + first - begin
                write_at(memory, pixels.data.cast("B"), part.offset + place * pixels[0].nbytes)
        size = len(outputs) * part.total * pixels[0].nbytes
    extrapolations = tuple(support.completed(begin, end))
    return replace(
        rendered,
        size=size,
        render_ms=rendered.render_ms + frames.waited_ms,
        encode_ms=_since_ms(started) - (frames.waited_ms - waited_ms),
        first=part.first,
        extrapolations=extrapolations,
    )


def _pack(task: PackTask, pixels_memory: int, archive_memory: int) -> Rendered:
    """The .npz of float32 frames that parts left in memory, output after output."""
    started = time.monotonic()
    picture = task.settings.picture
    shape = (len(task.settings.outputs), len(task.poses), picture.height, picture.width)
    with (
        mmap.mmap(pixels_memory, 4 * int(np.prod(shape)), prot=mmap.PROT_READ) as pixels,
        os.fdopen(os.dup(archive_memory), "wb") as file,
    ):
        frames = np.frombuffer(pixels, dtype="<f4").reshape(shape)
        size = write_npz(
            file,
            dict(zip(task.settings.outputs, frames, strict=True)),
            task.poses,
            task.extrapolations,
            scene=task.scene,
            scene_sha256=task.scene_sha256,
            renderer=task.renderer,
        )
        del frames  # the map cannot be closed while an array looks into it
    return Rendered(
        size=size,
        scene_sha256=task.scene_sha256,
        renderer=task.renderer,
        started=started,
        render_ms=0.0,
        encode_ms=_since_ms(started),
    )


_GIVEN_UP = RenderFailed("the service gave up this rendering: nobody waited for it any more")


def _outcome(work: Callable[[], Rendered | None]) -> Outcome:
    """What work comes to, whatever it raises."""
    try:
        return work()
    except GivenUp:
        return _GIVEN_UP
    except SceneChangedError as error:
        return error
    except Exception as error:
        return _as_reported(error)


def _as_reported(error: Exception) -> UltragrayError:
    """The error as the service gets it: ours as they are, all others as RenderFailed and in the log.

    Raises the CUDA error that has cost this process its GPU: a new process gets it back.
    """
    if not isinstance(error, UltragrayError):
        if torch.cuda.is_initialized():  # type: ignore[no-untyped-call]
            torch.cuda.synchronize()
        logger.error("rendering failed", exc_info=error)
        return RenderFailed(f"rendering failed: {type(error).__name__}: {error}"[:MAX_DETAIL_LENGTH])
    if len(error.detail) > MAX_DETAIL_LENGTH:  # such as the tensor names of a hostile file
        return type(error)(error.detail[:MAX_DETAIL_LENGTH] + "…", field=error.field)
    return error


def _since_ms(started: float) -> float:
    return (time.monotonic() - started) * 1000.0


MAX_SCENES = 256
_READ_ATTEMPTS = 3


@dataclass(frozen=True, eq=False)
class LoadedScene:
    scene: GaussianScene
    sha256: str  # of the very bytes the tensors were read from
    version: FileVersion
    bytes: int

    @cached_property
    def assessor(self) -> Assessor:
        """The assessor of its frames' extrapolation."""
        return Assessor(self.scene.info, self.scene.training_poses)


class SceneCache:
    """At most `budget_bytes` of scenes on a device, as `resident_bytes` counts them."""

    def __init__(self, budget_bytes: int, device: torch.device) -> None:
        self._budget_bytes = budget_bytes
        self._device = device
        self._scenes: OrderedDict[str, LoadedScene] = OrderedDict()  # least recently used first

    def names(self) -> tuple[str, ...]:
        return tuple(self._scenes)

    def get(self, name: str, path: str) -> LoadedScene:
        """The scene of a file as it is now. Raises SceneFileInvalid, SceneTooLarge, MemoryExceeded."""
        if (scene := self.held(name, path)) is not None:
            return scene
        self._make_room(name, path)
        self._scenes[name] = loaded = self._load(name, path)
        return loaded

    def held(self, name: str, path: str) -> LoadedScene | None:
        """The scene where it need not be loaded: it is here, and its file is the same. Raises SceneFileInvalid."""
        try:
            version = _version(path)
        except SceneFileInvalid:
            self.drop(name)
            raise
        scene = self._scenes.get(name)
        if scene is not None and scene.version == version:
            self._scenes.move_to_end(name)
            return scene
        self.drop(name)
        return None

    def drop(self, name: str) -> None:
        self._scenes.pop(name, None)

    def _make_room(self, name: str, path: str) -> None:
        needed = resident_bytes(read_header(path).info)
        if needed > self._budget_bytes:
            raise SceneTooLarge(
                f"scene {name!r} needs {_megabytes(needed)}, the memory budget for scenes is "
                f"{_megabytes(self._budget_bytes)}",
                field="scene",
            )
        while self._scenes and (self._held_bytes() + needed > self._budget_bytes or len(self._scenes) >= MAX_SCENES):
            self._scenes.popitem(last=False)

    def _load(self, name: str, path: str) -> LoadedScene:
        loaded = _read(path)
        try:
            return replace(loaded, scene=loaded.scene.to(self._device))
        except torch.OutOfMemoryError as error:
            raise MemoryExceeded(
                f"scene {name!r} of {_megabytes(loaded.bytes)} does not fit into the free memory of {self._device}; "
                f"the memory budget for scenes is {_megabytes(self._budget_bytes)}, a lower one leaves more room",
                field="scene",
            ) from error

    def _held_bytes(self) -> int:
        return sum(loaded.bytes for loaded in self._scenes.values())


def _read(path: str) -> LoadedScene:
    """Tensors and hash of the same bytes: read again when the file changed in between."""
    for _ in range(_READ_ATTEMPTS):
        version = _version(path)
        try:
            scene, sha256 = GaussianScene.load(path), file_sha256(path)
        except (UltragrayError, OSError) as error:
            if _version(path) == version:
                raise (error if isinstance(error, UltragrayError) else scene_file_invalid(path, error)) from error
            continue
        if _version(path) == version:
            return LoadedScene(scene=scene, sha256=sha256, version=version, bytes=resident_bytes(scene.info))
    raise SceneFileInvalid(f"{path}: it changed {_READ_ATTEMPTS} times while it was being read")


def _version(path: str) -> FileVersion:
    try:
        return FileVersion.of(path)
    except OSError as error:
        raise scene_file_invalid(path, error) from error


def _megabytes(count: int) -> str:
    return f"{count / 2**20:.1f} MiB"
