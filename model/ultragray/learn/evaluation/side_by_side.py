"""Pictures for the eye: the real frame, the rendered one, their difference, and what the rendering is made of."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from ultragray.files import write_whole
from ultragray.geometry.scan_conversion import with_square_pixels
from ultragray.learn.evaluation.metrics import FrameMetrics
from ultragray.learn.evaluation.scoring import Evaluation, render_sweep
from ultragray.learn.sweep import Sweep, spread_places
from ultragray.rendering.pixels import ByteArray, png_file, to_uint8
from ultragray.scene.gaussians import GaussianScene

MAX_SIDE_PIXELS = 512  # of one panel
GAP_PIXELS = 6
TITLE_PIXELS = 22
BACKGROUND, INK = 255, 40
DIFFERENCE_GAIN = 3.0  # small differences would be black


def write_side_by_side(
    scene: GaussianScene, sweep: Sweep, metrics: list[FrameMetrics], folder: str | Path, *, backend: str = "auto"
) -> list[Path]:
    """Writes one PNG per frame into `folder`, which is made, and returns their paths.

    Panels from left to right: truth, rendering, |difference| x 3, echo, transmittance, with square pixels; frames of
    convex and phased probes are drawn as fans. `metrics` (of the same frames) is written below.
    """
    panels = side_by_side_panels(scene, sweep, backend=backend)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for place, (number, reached) in enumerate(zip(sweep.frame_numbers, metrics, strict=True)):
        caption = (
            f"frame {number}: PSNR {reached.psnr_db:.2f} dB, MS-SSIM {reached.ms_ssim:.3f}, "
            f"GMS {reached.gms:.3f}, GMSD {reached.gmsd:.3f}"
        )
        picture = _row({title: images[place] for title, images in panels.items()}, sweep, caption)
        paths.append(folder / f"frame_{number:05d}.png")
        write_whole(paths[-1], png_file(picture))
    return paths


def write_spread(scene: GaussianScene, sweep: Sweep, evaluation: Evaluation, folder: str | Path, count: int) -> None:
    """As `write_side_by_side`, of at most `count` frames of an evaluated sweep, evenly spread."""
    places = spread_places(len(sweep), count)
    write_side_by_side(scene, sweep.select(places), [evaluation.frames[place] for place in places], folder)


def side_by_side_panels(
    scene: GaussianScene, sweep: Sweep, *, backend: str = "auto"
) -> dict[str, npt.NDArray[np.float32]]:  # each [F, H, W] in [0, 1]
    truth = (sweep.images / 255.0).astype(np.float32)
    rendered = render_sweep(scene, sweep, backend=backend)
    return {
        "truth": truth,
        "rendering": rendered,
        f"|difference| x {DIFFERENCE_GAIN:g}": np.minimum(np.abs(rendered - truth) * DIFFERENCE_GAIN, 1.0),
        "echo": render_sweep(scene, sweep, output="echo", backend=backend),
        "transmittance": render_sweep(scene, sweep, output="transmittance", backend=backend),
    }


def as_picture(frame: npt.NDArray[np.float32], sweep: Sweep, max_side: int = MAX_SIDE_PIXELS) -> ByteArray:
    """A frame [H, W] in [0, 1] as the eye expects it: square pixels, a fan as one, the longer side `max_side`."""
    return to_uint8(with_square_pixels(frame, sweep.probe, max_side))


def _row(panels: Mapping[str, npt.NDArray[np.float32]], sweep: Sweep, caption: str) -> ByteArray:
    drawn = {title: as_picture(frame, sweep) for title, frame in panels.items()}
    height, width = next(iter(drawn.values())).shape
    canvas = np.full((height + 2 * TITLE_PIXELS, len(drawn) * (width + GAP_PIXELS) - GAP_PIXELS), BACKGROUND, np.uint8)
    for place, (title, picture) in enumerate(drawn.items()):
        left = place * (width + GAP_PIXELS)
        canvas[TITLE_PIXELS : TITLE_PIXELS + height, left : left + width] = picture
        _write(canvas, title, left + 2, TITLE_PIXELS - 7)
    _write(canvas, caption, 2, height + 2 * TITLE_PIXELS - 7)
    return canvas


def _write(canvas: ByteArray, text: str, left: int, baseline: int) -> None:
    cv2.putText(canvas, text, (left, baseline), cv2.FONT_HERSHEY_SIMPLEX, 0.42, INK, 1, cv2.LINE_AA)
