"""Rendering to files: the frames of many poses, portion by portion, into what an exporter or a folder of PNGs takes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager

import torch

from ..confidence import Extrapolation
from ..confidence.support import SupportWatch
from ..display.frames import show
from ..evaluation.scoring import frames_at_once
from ..rendering import render
from ..scene import GaussianScene
from .exports import Add, ExportHeader


def render_into(
    sink: AbstractContextManager[Add],
    header: ExportHeader,
    scene: GaussianScene,
    extrapolations: Sequence[Extrapolation],  # [C]
    *,
    masked: Sequence[bool] | None = None,  # [C]
    backend: str = "auto",
    before_portion: Callable[[int], object] | None = None,
) -> list[Extrapolation]:  # [C]
    """Render the frames that a header describes, and give them to a sink: `export_to(…)`, `export_pngs(…)`.

    `scene` lies where the backend renders. `masked`: for each pose whether pixels without support are black.
    `before_portion` is told how many frames are done, at last all of them; to stop, it raises. Returns the
    extrapolations with the share of each frame that has support. Raises what `render` and the sink raise.
    """
    masked = [False] * len(header.poses) if masked is None else masked
    wanted = tuple(dict.fromkeys((*header.outputs, "coverage")))
    size = {"height": header.height, "width": header.width}
    portion = frames_at_once(**size)
    found: list[Extrapolation] = []
    with sink as add, torch.no_grad():
        for first in range(0, len(header.poses), portion):
            if before_portion is not None:
                before_portion(first)
            places = slice(first, first + portion)
            frames = render(scene, header.probe, header.poses[places], **size, outputs=wanted, backend=backend)
            assert frames.coverage is not None
            watch = SupportWatch(masked[places])
            blackened = watch.look(frames.coverage)
            asked = {name: getattr(frames, name) for name in header.outputs}
            shown = show(asked, header.probe, header.display, blackened)
            found.extend(watch.told(extrapolations[places]))
            add({name: pixels.cpu().numpy() for name, pixels in shown.items()}, found[first:])
        if before_portion is not None:
            before_portion(len(header.poses))
    return found
