"""`ultragray render`: the poses of a file into an .npz or a folder of PNGs, in chunks that fit in memory."""

from __future__ import annotations

import contextlib
import json
import shutil
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

from ultragray.errors import InvalidArgument, InvalidProbe
from ultragray.files import atomic_path, file_sha256
from ultragray.pose_file import load_poses
from ultragray.probe import ConvexProbe, Probe, probe_from_dict
from ultragray.rendering import render, renderer_name
from ultragray.request import check_image_size, check_outputs
from ultragray.scene import GaussianScene
from ultragray_workers.encoding import encode_image
from ultragray_workers.placement import render_device
from ultragray_workers.types import Encoding

from .cli_output import check_writable

CHUNK_BYTES = 64 << 20  # of float32 pixels rendered at once
OTHER_FILES = (".npy", ".zip", ".png", ".jpg", ".jpeg", ".ugr")

FrameArray = npt.NDArray[np.float32]  # [C, H, W]
Sink = Callable[[Mapping[str, FrameArray]], None]


@dataclass(frozen=True)
class RenderOptions:
    """The options of the command, as typed."""

    scene: Path
    output: Path
    poses: Path | None
    height: int | None
    width: int | None
    outputs: tuple[str, ...]
    probe_json: str | None
    scan_convert_mm: float | None
    backend: str
    threads: int


def render_to_files(options: RenderOptions) -> str:
    """Renders and writes; returns one sentence about what was done.

    Raises InvalidArgument and its kind, SceneFileInvalid, BackendUnavailable, MemoryExceeded and OSError; an
    .npz is then not written.
    """
    outputs = check_outputs(options.outputs)
    to_npz = _writes_npz(options.output)
    given_probe = None if options.probe_json is None else _parse_probe(options.probe_json)
    given_poses = None if options.poses is None else load_poses(options.poses)
    scene = GaussianScene.load(options.scene)
    try:
        probe = scene.info.probe_or(given_probe)
    except InvalidProbe as error:
        raise InvalidProbe(f"--{error.detail}", field="probe") from None  # as the option is called here
    poses = scene.training_poses if given_poses is None else given_poses
    if not len(poses):
        raise InvalidArgument("--poses must be given: the scene holds no training poses", field="poses")
    height, width = scene.info.image_size_or(options.height, options.width)
    check_image_size(height, width)
    scene = scene.to(render_device(options.backend))
    draw = _drawing(options.scan_convert_mm, probe, to_npz)
    if options.threads:
        torch.set_num_threads(options.threads)

    labels = {
        "poses": poses,
        "scene": options.scene.stem,
        "scene_sha256": file_sha256(options.scene),
        "renderer": renderer_name(options.backend, scene),
    }
    sink = (
        _npz_sink(options.output, outputs, (len(poses), height, width), labels)
        if to_npz
        else _png_sink(options.output, draw)
    )
    started = time.perf_counter()
    chunk = max(1, CHUNK_BYTES // (4 * height * width * len(outputs)))
    with sink as add, _progress(len(poses)) as advance:
        for start in range(0, len(poses), chunk):
            some = poses[start : start + chunk]
            frames = render(scene, probe, some, height=height, width=width, outputs=outputs, backend=options.backend)
            add({name: getattr(frames, name).cpu().numpy() for name in outputs})
            advance(len(some))
    elapsed_s = time.perf_counter() - started
    what = f"{len(poses)} frames of {height}x{width}, {', '.join(outputs)}"
    return f"wrote {options.output}: {what}, in {elapsed_s:.1f} s"


def _writes_npz(output: Path) -> bool:
    if output.suffix == ".npz":
        check_writable(output)
        return True
    if output.is_file() or (output.suffix in OTHER_FILES and not output.is_dir()):
        raise InvalidArgument(f"output must be an .npz file or a folder for PNGs, got {output}", field="output")
    return False


def _parse_probe(text: str) -> Probe:
    try:
        return probe_from_dict(json.loads(text))
    except (json.JSONDecodeError, RecursionError) as error:
        raise InvalidArgument(f"--probe must be a JSON object: {error}", field="probe") from error


def _drawing(pixel_mm: float | None, probe: Probe, to_npz: bool) -> Callable[[FrameArray], FrameArray]:
    """How a frame [H, W] becomes a picture: as it is, or as the fan it was seen in."""
    if pixel_mm is None:
        return lambda frame: frame
    if to_npz or not isinstance(probe, ConvexProbe):
        raise InvalidArgument("--scan-convert draws PNGs of a convex probe only", field="scan_convert")
    side_mm = 2.0 * probe.far_mm
    if not 0 < pixel_mm <= side_mm or side_mm / pixel_mm > 2**14:
        raise InvalidArgument(
            f"--scan-convert must be between {side_mm / 2**14:.2g} and {side_mm:g} mm, got {pixel_mm:g}",
            field="scan_convert",
        )
    return lambda frame: probe.scan_convert(frame, pixel_mm)


@contextlib.contextmanager
def _npz_sink(
    path: Path, outputs: tuple[str, ...], shape: tuple[int, int, int], labels: Mapping[str, Any]
) -> Iterator[Sink]:
    """One array [C, H, W] per output, streamed; the archive takes one at a time, others wait beside it."""
    first, *others = outputs
    with (
        atomic_path(path) as temporary,
        zipfile.ZipFile(temporary, "w") as archive,
        contextlib.ExitStack() as stack,
    ):
        spools = {name: stack.enter_context(tempfile.TemporaryFile(dir=path.absolute().parent)) for name in others}
        with archive.open(f"{first}.npy", "w", force_zip64=True) as member:
            files: dict[str, IO[bytes]] = {first: member, **spools}
            header = {"descr": "<f4", "fortran_order": False, "shape": shape}
            for file in files.values():
                np.lib.format.write_array_header_1_0(file, header)

            def add(frames: Mapping[str, FrameArray]) -> None:
                for name, values in frames.items():
                    files[name].write(np.ascontiguousarray(values, dtype="<f4").data)

            yield add
        for name, spool in spools.items():
            spool.seek(0)
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                shutil.copyfileobj(spool, member, 1 << 20)
        for name, value in labels.items():
            with archive.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, np.asarray(value), allow_pickle=False)


@contextlib.contextmanager
def _png_sink(folder: Path, draw: Callable[[FrameArray], FrameArray]) -> Iterator[Sink]:
    """One grey PNG per frame and output."""
    written = 0

    def add(frames: Mapping[str, FrameArray]) -> None:
        nonlocal written
        folder.mkdir(parents=True, exist_ok=True)  # only now: a mistake that render() finds leaves no folder
        for name, values in frames.items():
            for offset, frame in enumerate(values):
                data = encode_image(draw(frame), Encoding.PNG)
                (folder / f"frame_{written + offset:05d}_{name}.png").write_bytes(data.tobytes())
        written += len(next(iter(frames.values())))

    yield add


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
