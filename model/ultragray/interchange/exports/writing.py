"""Writing an export beside the rendering: a thread takes the frames, two portions may wait."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeAlias

from ultragray.confidence import Extrapolation
from ultragray.display.pixels import PixelArray
from ultragray.files.atomic import atomic_path
from ultragray.interchange.exports.exporter import Exporter, ExportHeader, stored_pixels
from ultragray.interchange.exports.formats import exporter_class

WAITING_PORTIONS = 2

# The next frames, each output [B, H, W], and the extrapolation of each, [B]; neither is changed after.
Add: TypeAlias = Callable[[Mapping[str, PixelArray], Sequence[Extrapolation]], None]
Portion: TypeAlias = tuple[Mapping[str, PixelArray], Sequence[Extrapolation]]


@contextmanager
def export_to(path: str | Path, format: str, header: ExportHeader) -> Iterator[Add]:
    """A function that takes the rendered frames in order; at the end `path` is there, whole, or not at all.

    The frames are converted and written by a thread of its own: the function returns at once unless two portions
    wait. An error of the writing is raised by the next call, or at the end. Raises ExtraMissing, InvalidArgument,
    OSError.
    """
    make = exporter_class(format)
    with atomic_path(path) as temporary:
        exporter = make(temporary, header)
        try:
            with _beside(exporter, header) as add:
                yield add
        except BaseException:
            exporter.abandon()
            raise
        exporter.close()


@contextmanager
def _beside(exporter: Exporter, header: ExportHeader) -> Iterator[Add]:
    waiting: queue.Queue[Portion | None] = queue.Queue(WAITING_PORTIONS)
    failed: list[BaseException] = []
    given_up = threading.Event()

    def write() -> None:
        while (portion := waiting.get()) is not None:
            if failed or given_up.is_set():
                continue
            frames, extrapolations = portion
            try:
                stored = {
                    name: stored_pixels(frames[name], header.pixel_type(name)) for name in header.settings.outputs
                }
                exporter.add(stored, extrapolations)
            except BaseException as error:
                failed.append(error)

    def add(frames: Mapping[str, PixelArray], extrapolations: Sequence[Extrapolation]) -> None:
        if failed:
            raise failed[0]
        waiting.put((frames, extrapolations))

    writer = threading.Thread(target=write, name="export")
    writer.start()
    try:
        yield add
    except BaseException:
        given_up.set()
        raise
    finally:
        waiting.put(None)
        writer.join()
    if failed:
        raise failed[0]
