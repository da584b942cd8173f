"""`ultragray render`: poses into one file, a folder of PNGs, or shards of a cluster.

Everything that can be wrong is found before torch is imported.
"""

from __future__ import annotations

import contextlib
import shutil
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from ultragray.errors import InvalidArgument, InvalidProbe
from ultragray.exchange.batches import MANIFEST_FILE, SHARD_FRAMES, BatchPlan
from ultragray.exchange.exports.formats import DTYPES, FORMATS, check_format, exporter_class, format_of, frame_bytes
from ultragray.exchange.poses import load_poses
from ultragray.files import file_sha256
from ultragray.rendering.settings import Encoding, FrameSettings
from ultragray.samplers import Sampler, TrainingSampler, assessed_poses
from ultragray.samplers.confident import require_drawn
from ultragray.scene.confidence import CONTACT_FIGURES, Assessor, figure_arrays
from ultragray.scene.info import read_header
from ultragray_service.cli.options import poses_option, with_options
from ultragray_service.cli.terminal import (
    COMPUTE,
    OR_A_FOLDER,
    OUTPUT,
    Backend,
    Force,
    Json,
    SceneFile,
    check_ending,
    check_file,
    check_folder,
    counted,
    frames_in_words,
    is_folder_name,
    option,
    output_option,
    single,
    tell,
)

SHARDS = "Shards"
SUFFIXES = tuple(one.suffix for one in FORMATS.values())


@single(
    "ultragray render liver.ugr -o frames.npz  # the training poses",
    "ultragray render liver.ugr -o pictures/ --poses path.npy  # a folder of PNGs",
    "ultragray render liver.ugr -o augmented.tar --sampler around --count 500 --translation-mm 3",
    "ultragray render liver.ugr -o labels.h5 --outputs bmode,labels --min-confidence 0.8",
    "ultragray render liver.ugr -o s3://frames/liver --sampler around --count 10000000 --on ray://head:10001",
)
@with_options
def render(
    scene: SceneFile,
    output: Annotated[
        str,
        output_option(
            f"A file ({', '.join(SUFFIXES)}), or a folder for PNGs (frame_00000_bmode.png); with --on a folder or "
            "s3://BUCKET/PREFIX for shards (frames-000000.tar)."
        ),
    ],
    dtype: Annotated[
        str | None, option(f"{' or '.join(DTYPES)}, of a file.", shown="the format's own", panel=OUTPUT)
    ] = None,
    force: Force = False,
    json: Json = False,
    poses: Annotated[Path | None, poses_option(default="the scene's training poses")] = None,
    *,
    sampler: Sampler | None,
    settings: FrameSettings,
    backend: Backend = "auto",
    threads: Annotated[int, option("Render threads; 0: all cores, of a shard one.", min=0, panel=COMPUTE)] = 0,
    on: Annotated[
        str | None,
        option(
            "Render in shards on a Ray cluster, or on one of this machine; what is there already is kept.",
            metavar="ray|ray://HEAD:PORT",
            shown=False,
            panel=SHARDS,
        ),
    ] = None,
    shard_frames: Annotated[
        int | None, option("Frames of a shard.", min=1, shown=f"{SHARD_FRAMES:,}", panel=SHARDS)
    ] = None,
) -> None:
    """Each frame comes with its pose and with how far it can be trusted. Lengths are in mm, angles in degrees."""
    if on is not None:
        plan = plan_of_shards(scene, poses, sampler, settings, dtype=dtype, shard_frames=shard_frames)
        sentence, document = render_shards(plan, scene, output, on, backend=backend, threads=threads)
        tell(sentence, document, as_json=json)
        return
    if shard_frames is not None:
        raise InvalidArgument("--shard-frames is of shards: name an engine with --on", field="shard_frames")
    path = Path(output)
    format = checked_format(path, settings, dtype, force=force)
    sentence, document = render_frames(
        scene, poses, sampler, settings, path, format=format, dtype=dtype, backend=backend, threads=threads
    )
    tell(sentence, document, as_json=json)


@contextlib.contextmanager
def _probe_as_an_option() -> Iterator[None]:
    try:
        yield
    except InvalidProbe as error:
        raise InvalidProbe(f"--{error.detail}", field="probe") from None


def checked_format(output: Path, settings: FrameSettings, dtype: str | None, *, force: bool) -> str | None:
    """The format of the output's name; None: a folder of PNGs. Raises InvalidArgument, ExtraMissing."""
    format = format_of(output.name)
    if format is None and not is_folder_name(output):
        check_ending(output, SUFFIXES, otherwise=OR_A_FOLDER)
    if format is None:
        if dtype is not None:
            raise InvalidArgument("--dtype must be left out for PNGs: they hold uint8", field="dtype")
        check_folder(output, force=force)
        return None
    check_file(output, force=force)
    check_format(format, settings.outputs, dtype)
    exporter_class(format)
    return format


def _check_room(output: Path, needed: int, frames: int) -> None:
    folder = next(one for one in output.absolute().parents if one.exists())
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise InvalidArgument(
            f"{frames_in_words(frames)} take up to {needed / 1e9:,.1f} GB, {folder} has {free / 1e9:,.1f} GB left",
            field="output",
        )


def render_frames(
    scene_file: Path,
    pose_file: Path | None,
    sampler: Sampler | None,
    request: FrameSettings,
    output: Path,
    *,
    format: str | None,
    dtype: str | None,
    backend: str,
    threads: int,
) -> tuple[str, dict[str, Any]]:
    """Render and write, None: a folder of PNGs; a sentence and a document of it. At an error no file is written."""
    given_poses = None if pose_file is None else load_poses(pose_file)
    header = read_header(scene_file)
    with _probe_as_an_option():
        settings = request.resolved(header.info, Encoding.FLOAT32)
    base = header.training_poses if given_poses is None else given_poses
    if not len(base):
        raise InvalidArgument("--poses must be given: the scene holds no training poses", field="poses")
    if sampler is None and given_poses is None:
        sampler = TrainingSampler()
    assess = partial(Assessor(header.info, header.training_poses).assess, probe=settings.probe, phase=settings.phase)
    poses, extrapolations = assessed_poses(sampler, base, settings.probe, assess, settings.least_confidence)
    picture = (settings if format is None else FORMATS[format].shown(settings)).picture
    stored = "uint8" if format is None else check_format(format, settings.outputs, dtype)
    _check_room(output, len(poses) * frame_bytes(settings.outputs, stored, picture), len(poses))

    import torch  # everything that can be wrong was found before

    from ultragray.exchange.rendering import assess_by_rendering, render_to_file
    from ultragray.rendering.backends.registry import render_device
    from ultragray.scene.gaussians import GaussianScene

    scene = GaussianScene.load(scene_file).to(render_device(backend))
    if threads:
        torch.set_num_threads(threads)
    started = time.perf_counter()
    if sampler is not None and settings.least_confidence is not None:  # until now poses alone were looked at
        seen = assess_by_rendering(scene, settings, assess, backend=backend)
        poses, extrapolations = assessed_poses(sampler, base, settings.probe, seen, settings.least_confidence)
    with counted("rendering", len(poses)) as report:
        assessments, _ = render_to_file(
            output,
            format,
            scene,
            settings,
            poses,
            extrapolations,
            dtype=dtype,
            scene_name=scene_file.stem,
            scene_sha256=file_sha256(scene_file),
            backend=backend,
            before_portion=report,
        )
    seconds = time.perf_counter() - started
    figures = figure_arrays(assessments)
    confidence, supported = figures["confidence"], float(figures["supported_share"].mean())
    knows = bool(np.isfinite(confidence).all())  # its confidence
    trust = [f"confidence {confidence.min():.2f} to {confidence.max():.2f}"] if knows else []
    trust.append(f"Gaussians support {supported:.0%} of the pixels")
    document = {
        "output": str(output),
        "frames": len(assessments),
        "height": settings.height,
        "width": settings.width,
        "outputs": list(settings.outputs),
        "seconds": round(seconds, 3),
        "confidence_min": float(confidence.min()) if knows else None,
        "confidence_max": float(confidence.max()) if knows else None,
        "supported_share": supported,
    }
    document |= {name: float(figures[name].mean()) for name in CONTACT_FIGURES if name in figures}
    if "contact_share" in document:
        trust.append(f"{document['contact_share']:.0%} of the scan lines have contact")
    if "force_n" in document:
        trust.append(f"pressed in by {document['indentation_mm']:.1f} mm with {document['force_n']:.1f} N")
    what = f"{frames_in_words(len(assessments))} of {settings.height}x{settings.width}, {', '.join(settings.outputs)}"
    return f"wrote {output}: {what}, in {seconds:.1f} s; {', '.join(trust)}", document


def plan_of_shards(
    scene_file: Path,
    pose_file: Path | None,
    sampler: Sampler | None,
    settings: FrameSettings,
    *,
    dtype: str | None,
    shard_frames: int | None,
) -> BatchPlan:
    poses = None if pose_file is None else load_poses(pose_file)
    header = read_header(scene_file)
    if settings.least_confidence is not None and sampler is not None:
        require_drawn(sampler)
    with _probe_as_an_option():
        return BatchPlan.prepared(
            header,
            settings,
            sampler=sampler,
            poses=poses,
            shard_frames=shard_frames,
            scene=scene_file.stem,
            scene_sha256=file_sha256(scene_file),
            dtype=check_format("tar", settings.outputs, dtype),
        )


def render_shards(
    plan: BatchPlan, scene_file: Path, output: str, on: str, *, backend: str, threads: int
) -> tuple[str, dict[str, Any]]:
    """Render what is missing of a batch on a cluster, and write its manifest; a sentence and a document of it."""
    from ultragray_workers.batches.on_ray import RayBatch, check_address
    from ultragray_workers.storage.location import parse_location

    check_address(on)
    if isinstance(location := parse_location(output, "output"), Path):
        folder = location.resolve()
        if folder.exists() and not folder.is_dir():
            raise InvalidArgument(f"--output must be a folder with --on, {output} is a file", field="output")
        output = str(folder)  # the workers of a cluster have other working folders
    started = time.perf_counter()
    with counted("rendering", plan.frames) as report:
        RayBatch(plan, scene_file, output, backend, threads or 1).render(on, report)
    seconds = time.perf_counter() - started
    document = {
        "output": output,
        "frames": plan.frames,
        "shards": plan.shard_count,
        "files": plan.file_names,
        "manifest": MANIFEST_FILE,
        "plan": plan.identity,
        "seconds": round(seconds, 3),
    }
    files = f"{plan.file_names} and {MANIFEST_FILE}"
    return f"wrote {output}: {frames_in_words(plan.frames)} in {files}, in {seconds:.1f} s", document
