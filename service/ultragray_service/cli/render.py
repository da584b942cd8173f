"""`ultragray render`: the poses of a file into one file or a folder of PNGs, in chunks that fit in memory."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

from ultragray.confidence import Assessor, Extrapolation, figure_arrays, require_confidence
from ultragray.errors import InvalidArgument, InvalidProbe
from ultragray.files.atomic import atomic_path, file_sha256
from ultragray.files.poses import load_poses
from ultragray.interchange.exports import FORMATS, ExportHeader, check_format, export_to, exporter_class
from ultragray.probe import FloatArray, LinearProbe, Probe, probe_from_dict
from ultragray.rendering import render, renderer_name
from ultragray.request import LABELS, check_image_size, check_labelled, check_min_confidence, check_outputs
from ultragray.samplers import Sampler, TrainingSampler, confident_poses, sampler_from_dict
from ultragray.scene import GaussianScene
from ultragray_workers.pool.process.encoding import PixelArray, encode_image
from ultragray_workers.pool.process.placement import render_device
from ultragray_workers.pool.process.support import with_support
from ultragray_workers.pool.types import Encoding

from .output import check_writable

CHUNK_BYTES = 16 << 20  # of float32 pixels rendered at once; some wait to be written
FRAMES_FILE = "frames.json"  # beside PNGs: the pose and the figures of each
OTHER_FILES = (".npy", ".zip", ".png", ".jpg", ".jpeg", ".ugr")

Sink = Callable[[Mapping[str, PixelArray], Sequence[Extrapolation]], None]


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
    if format is not None:
        dtype = check_format(format, outputs, options.dtype)
        exporter_class(format)
    elif options.dtype is not None:
        raise InvalidArgument("--dtype must be left out for PNGs: they hold uint8", field="dtype")
    sampler = None if options.sampler is None else sampler_from_dict(options.sampler)
    given_probe = None if options.probe_json is None else _parse_probe(options.probe_json)
    given_poses = None if options.poses is None else load_poses(options.poses)
    scene = GaussianScene.load(options.scene)
    check_labelled(outputs, scene.info)
    check_min_confidence(options.min_confidence, scene.info)
    try:
        probe = scene.info.probe_or(given_probe)
    except InvalidProbe as error:
        raise InvalidProbe(f"--{error.detail}", field="probe") from None  # as the option is called here
    base = scene.training_poses if given_poses is None else given_poses
    if not len(base):
        raise InvalidArgument("--poses must be given: the scene holds no training poses", field="poses")
    if sampler is None and given_poses is None:
        sampler = TrainingSampler()
    assessor = Assessor(scene.info, scene.training_poses)
    poses, extrapolations = _assessed(sampler, base, probe, assessor, options.min_confidence)
    height, width = scene.info.image_size_or(options.height, options.width)
    check_image_size(height, width)
    scene = scene.to(render_device(options.backend))
    draw = _drawing(options.scan_convert_mm, probe, format)
    if options.threads:
        torch.set_num_threads(options.threads)

    if format is None:
        sink = _png_sink(options.output, draw, poses)
    else:
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
        )
        sink = export_to(options.output, format, header)
    started = time.perf_counter()
    wanted = tuple(dict.fromkeys((*outputs, "coverage")))
    chunk = max(1, CHUNK_BYTES // (4 * height * width * len(wanted)))
    told: list[Extrapolation] = []
    with sink as add, _progress(len(poses)) as advance:
        for start in range(0, len(poses), chunk):
            some = poses[start : start + chunk]
            frames = render(scene, probe, some, height=height, width=width, outputs=wanted, backend=options.backend)
            assert frames.coverage is not None
            told.extend(with_support(extrapolations[start : start + len(some)], frames.coverage))
            add({name: getattr(frames, name).cpu().numpy() for name in outputs}, told[start:])
            advance(len(some))
    elapsed_s = time.perf_counter() - started
    what = f"{len(poses)} frames of {height}x{width}, {', '.join(outputs)}"
    return f"wrote {options.output}: {what}, in {elapsed_s:.1f} s; {_trust(told)}"


def _assessed(
    sampler: Sampler | None, base: FloatArray, probe: Probe, assessor: Assessor, min_confidence: float | None
) -> tuple[FloatArray, Sequence[Extrapolation]]:  # [P, 4, 4] -> [C, 4, 4] mm, [C]
    def assess(poses: FloatArray) -> Sequence[Extrapolation]:
        return assessor.assess(poses, probe)

    if sampler is not None and min_confidence is not None:
        return confident_poses(sampler, base, probe, assess, min_confidence)
    poses = base if sampler is None else sampler.poses(base, probe)
    extrapolations = assess(poses)
    require_confidence(extrapolations, min_confidence)
    return poses, extrapolations


def _trust(told: Sequence[Extrapolation]) -> str:
    """In words: the confidence where it is known, and how much of the frames has support."""
    figures = figure_arrays(told)
    confidence = figures["confidence"]
    words = [f"Gaussians support {figures['supported_share'].mean():.0%} of the pixels"]
    if np.isfinite(confidence).all():
        words.insert(0, f"confidence {confidence.min():.2f} to {confidence.max():.2f}")
    return ", ".join(words)


def _format(output: Path) -> str | None:
    """The format that the name of the output stands for; None for a folder."""
    for name, format in FORMATS.items():
        if output.name.endswith(format.suffix):
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
        return probe_from_dict(json.loads(text))
    except (json.JSONDecodeError, RecursionError) as error:
        raise InvalidArgument(f"--probe must be a JSON object: {error}", field="probe") from error


def _drawing(pixel_mm: float | None, probe: Probe, format: str | None) -> Callable[[str, PixelArray], PixelArray]:
    """How a frame [H, W] of an output becomes a picture: as it is, or as the fan it was seen in."""
    if pixel_mm is None:
        return lambda _, frame: frame
    if format is not None or isinstance(probe, LinearProbe):
        raise InvalidArgument("--scan-convert draws PNGs of a convex or phased probe only", field="scan_convert")
    side_mm = 2.0 * probe.far_mm
    if not 0 < pixel_mm <= side_mm or side_mm / pixel_mm > 2**14:
        raise InvalidArgument(
            f"--scan-convert must be between {side_mm / 2**14:.2g} and {side_mm:g} mm, got {pixel_mm:g}",
            field="scan_convert",
        )

    def as_fan(name: str, frame: PixelArray) -> PixelArray:
        convert = probe.scan_convert_labels if name == LABELS else probe.scan_convert
        return convert(frame, pixel_mm)

    return as_fan


@contextlib.contextmanager
def _png_sink(folder: Path, draw: Callable[[str, PixelArray], PixelArray], poses: FloatArray) -> Iterator[Sink]:
    """One grey PNG per frame and output, a pixel of labels holds the label; at the end FRAMES_FILE tells of each."""
    written = 0
    documents: list[dict[str, Any]] = []

    def add(frames: Mapping[str, PixelArray], extrapolations: Sequence[Extrapolation]) -> None:
        nonlocal written
        folder.mkdir(parents=True, exist_ok=True)  # only now: a mistake that render() finds leaves no folder
        for name, values in frames.items():
            for offset, frame in enumerate(values):
                data = encode_image(draw(name, frame), Encoding.PNG)
                (folder / f"frame_{written + offset:05d}_{name}.png").write_bytes(data.tobytes())
        for number, told in enumerate(extrapolations, written):
            documents.append({"frame": number, "pose": poses[number].tolist(), **asdict(told)})
        written += len(extrapolations)

    yield add
    with atomic_path(folder / FRAMES_FILE) as temporary:
        temporary.write_text(json.dumps(documents), encoding="utf-8")


@contextlib.contextmanager
def _progress(total: int) -> Iterator[Callable[[int], None]]:
    """A bar on a terminal's stderr; nothing elsewhere."""
    console = Console(stderr=True)
    columns = (
        "[progress.description]{task.description}",
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("rendering", total=total)
        yield lambda count: progress.advance(task, count)
