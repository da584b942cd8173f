"""`ultragray render`: the poses of a file into one file or a folder of PNGs, in chunks that fit in memory."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

from ultragray.confidence import Assessor, Extrapolation, figure_arrays
from ultragray.contract import from_dict
from ultragray.display import AS_RENDERED, Display
from ultragray.errors import InvalidArgument, InvalidProbe
from ultragray.files.atomic import file_sha256
from ultragray.files.poses import load_poses
from ultragray.interchange.exports import FORMATS, ExportHeader, check_format, export_to, exporter_class, format_of
from ultragray.interchange.exports.png_folder import export_pngs
from ultragray.interchange.rendering import render_into
from ultragray.outputs import check_outputs
from ultragray.probe import Probe
from ultragray.rendering import renderer_name
from ultragray.samplers import Sampler, TrainingSampler, assessed_poses
from ultragray.scene import GaussianScene
from ultragray.settings import Encoding, FrameSettings
from ultragray_workers.pool.process.placement import render_device

from .output import check_writable

OTHER_FILES = (".npy", ".zip", ".png", ".jpg", ".jpeg", ".ugr")


@dataclass(frozen=True)
class RenderOptions:
    """The options of the command, as typed."""

    scene: Path
    output: Path
    poses: Path | None
    sampler: dict[str, Any] | None  # its JSON object
    min_confidence: float | None
    height: int | None
    width: int | None
    outputs: tuple[str, ...]
    dtype: str | None
    probe_json: str | None
    scan_convert_mm: float | None
    backend: str
    threads: int


def render_to_files(options: RenderOptions) -> str:
    """Renders and writes; returns one sentence about what was done.

    Raises InvalidArgument and its kind, SceneFileInvalid, BackendUnavailable, MemoryExceeded, ExtraMissing and OSError;
    a file is then not written.
    """
    outputs = check_outputs(options.outputs)
    format = _format(options.output)
    if format is None and options.dtype is not None:
        raise InvalidArgument("--dtype must be left out for PNGs: they hold uint8", field="dtype")
    dtype = "uint8" if format is None else check_format(format, outputs, options.dtype)
    if format is not None:
        exporter_class(format)  # raises where its package is missing
    sampler = None if options.sampler is None else from_dict(Sampler, options.sampler)
    given_probe = None if options.probe_json is None else _parse_probe(options.probe_json)
    given_poses = None if options.poses is None else load_poses(options.poses)
    scene = GaussianScene.load(options.scene)
    asked = FrameSettings(
        probe=given_probe,
        height=options.height,
        width=options.width,
        outputs=outputs,
        min_confidence=options.min_confidence,
    )
    try:
        settings = asked.resolved(scene.info, Encoding.FLOAT32)
    except InvalidProbe as error:
        raise InvalidProbe(f"--{error.detail}", field="probe") from None  # as the option is called here
    probe, height, width = settings.probe, settings.height, settings.width
    base = scene.training_poses if given_poses is None else given_poses
    if not len(base):
        raise InvalidArgument("--poses must be given: the scene holds no training poses", field="poses")
    if sampler is None and given_poses is None:
        sampler = TrainingSampler()
    assessor = Assessor(scene.info, scene.training_poses)
    assess = partial(assessor.assess, probe=probe)
    poses, extrapolations = assessed_poses(sampler, base, probe, assess, options.min_confidence)
    scene = scene.to(render_device(options.backend))
    display = _display(options.scan_convert_mm, probe, format)
    if options.threads:
        torch.set_num_threads(options.threads)

    header = ExportHeader(
        outputs=outputs,
        dtype=dtype,
        poses=poses,
        height=height,
        width=width,
        probe=probe,
        scene=options.scene.stem,
        scene_sha256=file_sha256(options.scene),
        renderer=renderer_name(options.backend, scene),
        display=display if format is None else FORMATS[format].shown(display, probe, height),
    )
    sink = export_pngs(options.output, header) if format is None else export_to(options.output, format, header)
    started = time.perf_counter()
    with _progress(len(poses)) as report:
        found = render_into(sink, header, scene, extrapolations, backend=options.backend, before_portion=report)
    elapsed_s = time.perf_counter() - started
    what = f"{len(poses)} frames of {height}x{width}, {', '.join(outputs)}"
    return f"wrote {options.output}: {what}, in {elapsed_s:.1f} s; {_trust(found)}"


def _trust(found: Sequence[Extrapolation]) -> str:
    """In words: the confidence where it is known, and how much of the frames has support."""
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


def _parse_probe(text: str) -> Probe:
    try:
        return from_dict(Probe, json.loads(text))
    except (json.JSONDecodeError, RecursionError) as error:
        raise InvalidArgument(f"--probe must be a JSON object: {error}", field="probe") from error


def _display(pixel_mm: float | None, probe: Probe, format: str | None) -> Display:
    if pixel_mm is None:
        return AS_RENDERED
    if format is not None or probe.is_true_to_scale:
        raise InvalidArgument(
            "--scan-convert draws PNGs only, of probes whose frames are not true to scale", field="scan_convert"
        )
    return Display(pixel_mm=pixel_mm)


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
