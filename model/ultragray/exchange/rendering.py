"""Rendering to files: the frames of many poses, portion by portion, into an archive or a folder of PNGs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import torch

from ultragray.exchange.exports import FORMATS, ExportHeader, check_format, export_to
from ultragray.exchange.exports.archives import export_pngs
from ultragray.geometry.probe import FloatArray
from ultragray.learn.evaluation.scoring import CHUNK_FRAMES, frames_at_once
from ultragray.rendering.backends.registry import renderer_name
from ultragray.rendering.confidence import SupportWatch, supported_shares
from ultragray.rendering.frames import recorded_coverage, render_shown
from ultragray.rendering.limits import UNLIMITED, Limits
from ultragray.rendering.pixels import PixelArray
from ultragray.rendering.settings import Resolved
from ultragray.samplers import Assess
from ultragray.scene.confidence import Assessor, Extrapolation, is_confident, require_confidence
from ultragray.scene.gaussians import GaussianScene

__all__ = ["RenderedFile", "assess_by_rendering", "render_portions", "render_to_file"]

GREY_PIXELS = 1 << 22  # rendered at once where B-mode alone comes as bytes


def assess_by_rendering(
    scene: GaussianScene, settings: Resolved, assess: Assess, *, backend: str = "auto", limits: Limits = UNLIMITED
) -> Assess:
    """`assess` with the confidence that frames of `settings` will have, so that a sampler keeps to frames, not poses.

    The support of a frame is known when it is rendered: here its coverage alone is, where the pose has the least
    confidence of the settings. Without one, poses are assessed as before.
    """
    least = settings.least_confidence
    if least is None:
        return assess
    assessor = Assessor(scene.info, scene.training_poses)
    portion = frames_at_once(settings.height, settings.width)

    def assess_frames(poses: FloatArray) -> list[Extrapolation]:  # [C, 4, 4] -> [C]
        extrapolations = list(assess(poses))
        able = [place for place, one in enumerate(extrapolations) if is_confident(one, least)]
        for first in range(0, len(able), portion):
            places = able[first : first + portion]
            with torch.no_grad():
                coverage = recorded_coverage(scene, settings, poses[places], backend=backend, limits=limits)
            shares = supported_shares(coverage).tolist()
            for place, one in zip(
                places, assessor.with_support([extrapolations[i] for i in places], shares), strict=True
            ):
                extrapolations[place] = one
        return extrapolations

    return assess_frames


class RenderedFile(NamedTuple):
    """What became known of a file of frames as it was made."""

    extrapolations: list[Extrapolation]  # [C], with what the support of each frame tells
    sha256: str | None  # hexadecimal; None where its format is not written from the beginning to the end


def render_to_file(
    path: Path,
    format: str | None,
    scene: GaussianScene,
    settings: Resolved,
    poses: FloatArray,  # [C, 4, 4] mm
    extrapolations: Sequence[Extrapolation],  # [C]
    *,
    dtype: str | None = None,
    scene_name: str,
    scene_sha256: str,
    backend: str = "auto",
    limits: Limits = UNLIMITED,
    before_portion: Callable[[int], object] | None = None,
) -> RenderedFile:
    """Render frames into a file of a format (None: a folder of PNGs), which appears whole or not at all.

    `scene` lies where the backend renders; `poses` and `extrapolations` are those of `assessed_poses`. `before_portion`
    is told how many frames are done, at last all of them; to stop, it raises. Raises what `render` raises,
    InvalidArgument, ExtraMissing and OSError.
    """
    if format is not None:
        dtype = check_format(format, settings.outputs, dtype)
        settings = FORMATS[format].shown(settings)
    header = ExportHeader(
        settings=settings,
        dtype=dtype or "uint8",
        poses=poses,
        scene=scene_name,
        scene_sha256=scene_sha256,
        renderer=renderer_name(backend, scene),
    )
    results: list[Extrapolation] = []
    exporting = export_pngs(path, header) if format is None else export_to(path, format, header)
    portions = render_portions(
        scene,
        settings,
        poses,
        extrapolations,
        backend=backend,
        limits=limits,
        before_portion=before_portion,
        in_bytes=header.dtype == "uint8",
    )
    with exporting as writing, written_behind(writing) as write:
        for frames, figures in portions:
            write(frames, figures)
            results.extend(figures)
    return RenderedFile(results, writing.sha256)


def render_portions(
    scene: GaussianScene,
    settings: Resolved,
    poses: FloatArray,  # [C, 4, 4] mm
    extrapolations: Sequence[Extrapolation],  # [C]
    *,
    backend: str = "auto",
    limits: Limits = UNLIMITED,
    before_portion: Callable[[int], object] | None = None,
    assessor: Assessor | None = None,
    in_bytes: bool = False,
) -> Iterator[tuple[dict[str, PixelArray], list[Extrapolation]]]:  # [B, H, W] by output, [B]
    """The frames of many poses as they are shown, a portion at a time, with all figures of each.

    `before_portion` is told how many frames are done, at last all of them; to stop, it raises. `assessor`: the scene's,
    where the caller has one. `in_bytes`: as `render_shown`. Raises what `render` raises, and LowConfidence for a frame
    that turns out to be below the least confidence of the settings.
    """
    support = SupportWatch(assessor or Assessor(scene.info, scene.training_poses), extrapolations, settings)
    size = settings.height, settings.width
    is_grey = in_bytes and settings.outputs == ("bmode",)
    portion = _grey_frames_at_once(*size) if is_grey else frames_at_once(*size)
    for first in range(0, len(poses), portion):
        if before_portion is not None:
            before_portion(first)
        some = poses[first : first + portion]
        with torch.no_grad():
            after = limits.after(first)
            images = render_shown(
                scene, settings, some, backend=backend, limits=after, support=support, in_bytes=in_bytes
            )
        figures = support.completed(first, first + len(some))
        require_confidence(figures, settings.least_confidence, first=first)
        yield {name: pixels.cpu().numpy() for name, pixels in images.items()}, figures
    if before_portion is not None:
        before_portion(len(poses))


def _grey_frames_at_once(height: int, width: int) -> int:
    """More than of float32: with 16 frames of 512x512 the kernel's threads wait less for each other than with 4."""
    return min(CHUNK_FRAMES, max(1, GREY_PIXELS // (height * width)))


@contextmanager
def written_behind(write: Callable[..., object]) -> Iterator[Callable[..., None]]:
    """The same in a thread of its own, so that a portion is written while the next one is rendered, and not more than
    one waits. Raises what `write` raises, at the next call or at the end."""
    with ThreadPoolExecutor(1, "writer") as thread:
        latest: Future[object] | None = None

        def later(*arguments: Any) -> None:
            nonlocal latest
            if latest is not None:
                latest.result()
            latest = thread.submit(write, *arguments)

        yield later
        if latest is not None:
            latest.result()
