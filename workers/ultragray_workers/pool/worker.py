"""The worker process: takes tasks from its channel one at a time, renders, encodes, answers. Imports torch."""

from __future__ import annotations

import logging
import mmap
import os
import select
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ultragray.errors import LowConfidence, MemoryExceeded, RenderFailed, UltragrayError
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.learn.localization.pixels import read_grey, read_png
from ultragray.learn.localization.search import localize
from ultragray.rendering.backends import cuda
from ultragray.rendering.confidence import SupportWatch
from ultragray.rendering.display import AS_RENDERED
from ultragray.rendering.frames import render, renderer_name, show
from ultragray.rendering.limits import UNLIMITED, GivenUp, Limits
from ultragray.rendering.pixels import ByteArray, to_uint8
from ultragray.rendering.settings import Below, Encoding, Resolved
from ultragray.rendering.volume_fields import as_grey, sample_slice
from ultragray.rendering.volumes import SliceView
from ultragray.scene.confidence import Assessor, Extrapolation, is_confident, low_confidence
from ultragray.scene.gaussians import GaussianScene
from ultragray_workers.errors import DeadlineExceeded
from ultragray_workers.pool.channel import Board, Channel, read_start, write_at
from ultragray_workers.pool.messages import (
    Answer,
    ForkWorker,
    Hello,
    Loading,
    LoadTask,
    LocalizeTask,
    Outdated,
    PackTask,
    Rendered,
    RenderPart,
    RenderTask,
    SliceTask,
    Task,
    UnloadTask,
)
from ultragray_workers.pool.pixels import (
    CHUNK_POSES,
    Arriving,
    Wanted,
    encode_image,
    encode_pixels,
    render_to_host,
    write_npz,
)
from ultragray_workers.pool.scene_cache import LoadedScene, SceneCache, render_device

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
        self._max_footprint_pixels = settings.max_footprint_pixels
        self._backend = settings.backend
        self._device = render_device(settings.backend, settings.number)
        self.gpus = cuda.device_count() if self._device.type == "cuda" else 0
        if self.gpus:
            torch.cuda.set_device(self._device)  # kernels are launched on the current one
        processes = settings.processes or max(1, self.gpus)
        torch.set_num_threads(settings.threads or max(1, len(os.sched_getaffinity(0)) // processes))
        self._scenes = SceneCache(settings.memory_budget_bytes, self._device)

    def warm_up(self) -> None:
        """Renders and encodes small frames, so that the first request does not pay for first uses."""
        shapes = {"means": (1, 3), "scales": (1, 3), "transmittances": (1,), "sh0": (1, 1, 1)}
        splats = {name: torch.zeros(shape) for name, shape in shapes.items()} | {"quats": torch.ones(1, 4)}
        scene = GaussianScene.from_splats(splats).to(self._device)
        for frame in self._render_small(scene):
            encode_image(frame, Encoding.PNG)

    def do(self, task: Task, descriptors: list[int]) -> None:
        """Does one task and answers it, whatever happens."""
        self._tasks += 1
        self._board.taken[0] = self._tasks
        try:
            if isinstance(task, RenderTask):
                self._answer_all(self._render_parts(task, descriptors), len(task.parts))
            elif isinstance(task, SliceTask):
                self._answer_all(self._slice_parts(task, descriptors), len(task.parts))
            else:
                self._answer(0, self._do_other(task, descriptors), last=True)
        finally:
            for descriptor in descriptors:
                os.close(descriptor)

    def _answer_all(self, outcomes: Iterator[Rendered | Outdated | UltragrayError], parts: int) -> None:
        for part, outcome in enumerate(outcomes):
            self._answer(part, outcome, last=part == parts - 1)

    def _answer(self, part: int, outcome: Rendered | Outdated | UltragrayError | None, *, last: bool) -> None:
        self._channel.send(Answer(part=part, outcome=outcome, last=last, resident=self._scenes.names()))

    def _do_other(
        self, task: LocalizeTask | PackTask | LoadTask | UnloadTask, descriptors: list[int]
    ) -> Rendered | Outdated | UltragrayError | None:
        try:
            if isinstance(task, LocalizeTask):
                return self._localize(task, *descriptors)
            if isinstance(task, PackTask):
                return _pack(task, *descriptors)
            if isinstance(task, LoadTask):
                self._loaded(task.scene, task.path)
            else:
                self._scenes.drop(task.scene)
        except GivenUp:
            return _given_up()
        except Exception as error:
            return _as_reported(error)
        return None

    def _localize(self, task: LocalizeTask, memory: int) -> Rendered | Outdated:
        """Looks for the frame in the memory. Raises what reading it and localize() raise, and GivenUp."""
        loaded = self._loaded(task.scene, task.path)
        if task.version not in (None, loaded.version):
            return Outdated()
        started, asked = time.monotonic(), task.settings
        data = read_start(memory, task.image_bytes)
        found = localize(
            loaded.scene,
            read_png(data) if task.size is None else read_grey(data, *task.size),
            task.start,
            probe=asked.probe,
            within_mm=asked.within_mm,
            within_deg=asked.within_deg,
            backend=self._backend,
            limits=Limits(self._max_footprint_pixels, self._board.given_up, self._tasks, lambda _: "start"),
        )
        return Rendered(
            size=0,
            scene_sha256=loaded.sha256,
            renderer=renderer_name(self._backend, loaded.scene),
            started=started,
            render_ms=_since_ms(started),
            encode_ms=0.0,
            found=found,
        )

    def _loaded(self, name: str, path: str) -> LoadedScene:
        """A scene, ready for its first frame. Raises SceneFileInvalid, SceneTooLarge, MemoryExceeded."""
        if (held := self._scenes.held(name, path)) is not None:
            return held
        self._channel.send(Loading(begins=True))
        try:
            loaded = self._scenes.get(name, path)
            self._render_small(loaded.scene)  # lets the kernels prepare it
        finally:
            self._channel.send(Loading(begins=False))
        return loaded

    def _render_parts(
        self, task: RenderTask, memories: Sequence[int]
    ) -> Iterator[Rendered | Outdated | UltragrayError]:
        """One outcome per part, each as soon as its frames are written."""
        try:
            loaded = self._loaded(task.scene, task.path)
            if task.version not in (None, loaded.version):
                yield from [Outdated()] * len(task.parts)
                return
            poses = np.concatenate([part.poses for part in task.parts])  # [C, 4, 4]
            extrapolations = loaded.assessor.assess(poses, task.view.probe)
        except Exception as error:
            yield from [_as_reported(error)] * len(task.parts)
            return
        refused = refusal(task, extrapolations)
        if refused is not None and len(task.parts) == 1:
            yield refused
            return
        wanted: dict[str, set[np.dtype[Any]]] = {}
        for part in task.parts:
            for name in part.settings.outputs:
                wanted.setdefault(name, set()).add(part.settings.encoding.pixel_type)
        started = time.monotonic()
        support = SupportWatch(below_limit(task, extrapolations))
        limits = Limits(self._max_footprint_pixels, self._board.given_up, self._tasks, task.parts[0].name_pose)
        frames = None
        try:
            if refused is None:
                frames = self._render(loaded.scene, task.view, poses, wanted, support, limits)
        except GivenUp:
            yield from [_given_up()] * len(task.parts)
            return
        except Exception as error:
            if len(task.parts) == 1:
                yield _as_reported(error)
                return
        if frames is None:  # out of the handler: the error holds on to memory of the GPU
            for part, memory in zip(task.parts, memories, strict=True):  # alone: it may be one that fails
                yield from self._render_parts(replace(task, parts=(part,)), [memory])
            return
        rendered = Rendered(
            size=0,
            scene_sha256=loaded.sha256,
            renderer=renderer_name(self._backend, loaded.scene),
            started=started,
            render_ms=_since_ms(started),
            encode_ms=0.0,
        )
        begin = 0
        for part, memory in zip(task.parts, memories, strict=True):
            end = begin + len(part.poses)
            assessed = partial(_supported, loaded.assessor, extrapolations[begin:end], support, begin)
            if part.deadline is not None and time.monotonic() >= part.deadline:
                yield DeadlineExceeded("the deadline passed before the frames were written")
            else:
                yield _write_part(task.scene, part, frames, begin, memory, rendered, assessed)
            begin = end

    def _slice_parts(self, task: SliceTask, memories: Sequence[int]) -> Iterator[Rendered | Outdated | UltragrayError]:
        """One outcome per part, each as soon as its slices are written."""
        for part, memory in zip(task.parts, memories, strict=True):
            try:
                loaded = self._loaded(task.scene, task.path)
                if task.version not in (None, loaded.version):
                    yield Outdated()
                    continue
                started = time.monotonic()
                limits = Limits(self._max_footprint_pixels, self._board.given_up, self._tasks, lambda _: "spacing_mm")
                size = write_slices(loaded.scene, part, memory, limits)
            except GivenUp:
                yield RenderFailed("the service gave up this slice: nobody waited for it any more")
            except Exception as error:
                yield _as_reported(error)
            else:
                yield Rendered(
                    size=size,
                    scene_sha256=loaded.sha256,
                    renderer=renderer_name(self._backend, loaded.scene),
                    started=started,
                    render_ms=_since_ms(started),
                    encode_ms=0.0,
                    first=part.first,
                )

    def _render(
        self,
        scene: GaussianScene,
        view: Resolved,
        poses: FloatArray,  # [C, 4, 4] mm
        wanted: Wanted,
        support: SupportWatch,
        limits: Limits,
    ) -> Arriving:
        shot = 0

        def shoot(some: FloatArray) -> dict[str, Tensor]:  # [C, 4, 4] -> each [C, H, W] of the picture
            nonlocal shot
            frames = render(
                scene,
                view.probe,
                some,
                height=view.height,
                width=view.width,
                outputs=needed,
                backend=self._backend,
                limits=limits.after(shot),
                beam=view.beam,
                contact=view.contact,
                tools=view.tools,
                ghost=view.ghost,
            )
            shot += len(some)
            assert frames.coverage is not None
            blackened = support.look(frames.coverage, frames.touch)
            rendered = {name: frames[name] for name in outputs}
            if view.display == AS_RENDERED and blackened is None:
                return rendered
            return show(rendered, view.probe, view.display, blackened)

        outputs = tuple(wanted)
        needed = tuple(dict.fromkeys((*outputs, "coverage")))
        try:
            return render_to_host(shoot, poses, wanted, self._device)
        except torch.OutOfMemoryError as error:
            raise MemoryExceeded(
                f"{len(poses)} frames of {view.height}x{view.width} pixels ({', '.join(outputs)}) do not fit into the "
                f"free memory of {self._device}; ask for fewer or smaller ones"
            ) from error

    def _render_small(self, scene: GaussianScene) -> list[ByteArray]:  # each [16, 16]
        """A frame for each bundle of scan lines, as kernels differ by it."""
        pixel_type, small = Encoding.UINT8.pixel_type, []
        for probe in example_probes():
            view = Resolved(probe, 16, 16)
            frames = self._render(
                scene, view, np.eye(4)[None], {"bmode": {pixel_type}}, SupportWatch([False]), UNLIMITED
            )
            small.append(to_uint8(frames.take("bmode", pixel_type, 0, 1)[0]))
        return small


def example_probes() -> tuple[Probe, ...]:
    """One probe for each bundle of scan lines that probes have."""
    examples: list[Probe] = [member(**member.example()) for member in Probe.members.values()]
    return tuple({type(probe.lines): probe for probe in examples}.values())


def _supported(
    assessor: Assessor, extrapolations: Sequence[Extrapolation], support: SupportWatch, first: int
) -> tuple[Extrapolation, ...]:
    """The extrapolations of the frames from `first` on, with what was seen of their support."""
    return tuple(support.completed(assessor, extrapolations, first))


def _write_part(
    scene: str,
    part: RenderPart,
    frames: Arriving,  # of a batch that holds the part from its pose `begin` on
    begin: int,
    memory: int,
    rendered: Rendered,
    assessed: Callable[[], tuple[Extrapolation, ...]],
) -> Rendered | UltragrayError:
    """Encodes a part into its request's memory: a whole file, or its share of the pixels."""
    started, waited_ms = time.monotonic(), frames.waited_ms
    outputs, encoding, end = part.settings.outputs, part.settings.encoding, begin + len(part.poses)
    pixel_type = encoding.pixel_type
    try:
        if encoding.is_image_file:
            image = encode_image(frames.take(outputs[0], pixel_type, begin, end)[0], encoding)
            write_at(memory, image.data, 0)
            size = image.nbytes
        elif encoding is Encoding.NPZ and len(part.poses) == part.total:
            with os.fdopen(os.dup(memory), "wb") as file:
                size = write_npz(
                    file,
                    {name: frames.take(name, pixel_type, begin, end) for name in outputs},
                    part.poses,
                    assessed(),
                    scene=scene,
                    scene_sha256=rendered.scene_sha256,
                    renderer=rendered.renderer,
                )
        else:
            for first in range(begin, end, CHUNK_POSES):  # each is written while the next one arrives
                for number, name in enumerate(outputs):
                    pixels = encode_pixels(
                        frames.take(name, pixel_type, first, min(first + CHUNK_POSES, end)), encoding
                    )
                    place = number * part.total + part.first + first - begin
                    write_at(memory, pixels.data.cast("B"), place * pixels[0].nbytes)
            size = len(outputs) * part.total * pixels[0].nbytes
        extrapolations = assessed()
    except Exception as error:
        return _as_reported(error)
    waiting_ms = frames.waited_ms - waited_ms
    return replace(
        rendered,
        size=size,
        render_ms=rendered.render_ms + frames.waited_ms,
        encode_ms=_since_ms(started) - waiting_ms,
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


def _given_up() -> RenderFailed:
    return RenderFailed("the service gave up this rendering: nobody waited for it any more")


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


# Slices of a scene, sampled and written into their requests' memory.


def write_slices(scene: GaussianScene, part: RenderPart[SliceView], memory: int, limits: Limits) -> int:
    """Samples the slices of a part and writes them in the place of their request's; the bytes of the whole reply.

    Raises GivenUp, FrameTooCostly, and InvalidArgument for labels of a scene without them.
    """
    view, size = part.settings, 0
    for number, pose in enumerate(part.poses, part.first):
        pixels = sample_slice(scene, view.field, view.grid(pose), limits)
        if view.encoding is Encoding.PNG:
            pixels = encode_image(as_grey(pixels, view.field), Encoding.PNG)
        data = np.ascontiguousarray(pixels, pixels.dtype.newbyteorder("<"))
        write_at(memory, data.data.cast("B"), number * data.nbytes)
        size = part.total * data.nbytes
    return size


# Poses whose confidence is below the limit of a render job.


def below_limit(task: RenderTask, extrapolations: Sequence[Extrapolation]) -> list[bool]:
    """For each pose, whether it has less confidence than the task wants; a scene without a model has none."""
    limit = task.view.min_confidence
    return [limit is not None and not is_confident(one, limit) for one in extrapolations]


def refusal(task: RenderTask, extrapolations: Sequence[Extrapolation]) -> LowConfidence | None:
    """The reason not to render a task of one part; None where it is rendered."""
    limit = task.view.min_confidence
    if limit is None or task.view.below_min_confidence is not Below.REFUSE:
        return None
    for index, one in enumerate(extrapolations):
        if not is_confident(one, limit):
            return low_confidence(one, limit, task.parts[0].name_pose(index))
    return None
