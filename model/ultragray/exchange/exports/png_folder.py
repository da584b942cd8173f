"""A folder of grey PNGs, one a frame and output, a pixel of labels holding the label; FRAMES_FILE describes each."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ultragray.exchange.exports.exporter import ExportHeader
from ultragray.exchange.exports.formats import Add
from ultragray.files import atomic_path
from ultragray.rendering.outputs import OUTPUTS
from ultragray.rendering.pixels import PixelArray, image_file
from ultragray.scene.confidence import Extrapolation

FRAMES_FILE = "frames.json"


@contextmanager
def export_pngs(folder: Path, header: ExportHeader) -> Iterator[Add]:
    """A function that takes the rendered frames in order, and writes frame_00012_bmode.png and so on."""
    documents: list[dict[str, Any]] = []

    def add(frames: Mapping[str, PixelArray], extrapolations: Sequence[Extrapolation]) -> None:
        folder.mkdir(parents=True, exist_ok=True)  # only now: a mistake that the rendering finds leaves no folder
        for place, extrapolation in enumerate(extrapolations):
            number = len(documents)
            for name in header.settings.outputs:
                data = image_file(OUTPUTS[name].shares(frames[name][place]), ".png")
                (folder / f"frame_{number:05d}_{name}.png").write_bytes(data.tobytes())
            documents.append({"frame": number, "pose": header.poses[number].tolist(), **extrapolation.figures()})

    yield add
    with atomic_path(folder / FRAMES_FILE) as temporary:
        temporary.write_text(json.dumps(documents), encoding="utf-8")
