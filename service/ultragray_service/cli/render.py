"""`ultragray render`: the poses of a file into one file or a folder of PNGs, in chunks that fit in memory."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

from ultragray.confidence import Assessor, Extrapolation, figure_arrays
from ultragray.errors import InvalidArgument, InvalidProbe
from ultragray.files.atomic import file_sha256
from ultragray.files.poses import load_poses
from ultragray.interchange.exports import FORMATS, check_format, exporter_class, format_of
from ultragray.interchange.rendering import render_to_file
from ultragray.samplers import Sampler, TrainingSampler, assessed_poses
from ultragray.scene import GaussianScene
from ultragray.settings import Encoding, FrameSettings
from ultragray_workers.pool.process.placement import render_device

from .output import check_writable

OTHER_FILES = (".npy", ".zip", ".png", ".jpg", ".jpeg", ".ugr")


def render_frames(
    scene_file: Path,
    output: Path,
    pose_file: Path | None,
    sampler: Sampler | None,
    asked: FrameSettings,
    *,
    dtype: str | None,
    backend: str,
    threads: int,
) -> str:
    """Render and write; one sentence about what was done.

    Raises InvalidArgument and its kind, SceneFileInvalid, BackendUnavailable, MemoryExceeded, ExtraMissing and OSError;
    a file is then not written.
    """
    format = _format(output)
    if format is not None:
        check_format(format, asked.outputs, dtype)
        exporter_class(format)  # raises where its package is missing
    elif dtype is not None:
        raise InvalidArgument("--dtype must be left out for PNGs: they hold uint8", field="dtype")
    given_poses = None if pose_file is None else load_poses(pose_file)
    scene = GaussianScene.load(scene_file)
    try:
        settings = asked.resolved(scene.info, Encoding.FLOAT32)
    except InvalidProbe as error:
        raise InvalidProbe(f"--{error.detail}", field="probe") from None  # as the option is called here
    base = scene.training_poses if given_poses is None else given_poses
    if not len(base):
        raise InvalidArgument("--poses must be given: the scene holds no training poses", field="poses")
    if sampler is None and given_poses is None:
        sampler = TrainingSampler()
    assess = partial(Assessor(scene.info, scene.training_poses).assess, probe=settings.probe)
    poses, extrapolations = assessed_poses(sampler, base, settings.probe, assess, asked.least_confidence)
    if threads:
        torch.set_num_threads(threads)
    started = time.perf_counter()
    with _progress(len(poses)) as report:
        found = render_to_file(
            output,
            format,
            scene.to(render_device(backend)),
            settings,
            poses,
            extrapolations,
            dtype=dtype,
            scene_name=scene_file.stem,
            scene_sha256=file_sha256(scene_file),
            backend=backend,
            before_portion=report,
        )
    elapsed_s = time.perf_counter() - started
    what = f"{len(poses)} frames of {settings.height}x{settings.width}, {', '.join(settings.outputs)}"
    return f"wrote {output}: {what}, in {elapsed_s:.1f} s; {_trust(found)}"


def _trust(found: Sequence[Extrapolation]) -> str:
    """A few words on the confidence, where it is known, and on how much of the frames has support."""
    figures = figure_arrays(found)
    confidence = figures["confidence"]
    words = [f"Gaussians support {figures['supported_share'].mean():.0%} of the pixels"]
    if np.isfinite(confidence).all():
        words.insert(0, f"confidence {confidence.min():.2f} to {confidence.max():.2f}")
    return ", ".join(words)


def _format(output: Path) -> str | None:
    """The format that the name of the output stands for; None for a folder."""
    if (name := format_of(output.name)) is not None:
        check_writable(output)
        return name
    if output.is_file() or (output.suffix in OTHER_FILES and not output.is_dir()):
        suffixes = ", ".join(format.suffix for format in FORMATS.values())
        raise InvalidArgument(
            f"output must be a file that ends in {suffixes}, or a folder for PNGs, got {output}", field="output"
        )
    return None


@contextlib.contextmanager
def _progress(total: int) -> Iterator[Callable[[int], None]]:
    """A function that is told how many frames are done: a bar on a terminal's stderr, nothing elsewhere."""
    console = Console(stderr=True)
    columns = (
        "[progress.description]{task.description}",
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("rendering", total=total)
        yield lambda done: progress.update(task, completed=done)
