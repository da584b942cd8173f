"""`ultragray render`: poses into one file, a folder of PNGs, or shards of a cluster.

Everything that can be wrong is found before torch is imported.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from ultragray.errors import InvalidArgument, InvalidProbe
from ultragray.exchange.batches import MANIFEST_FILE, SHARD_FRAMES, BatchPlan
from ultragray.exchange.exports.formats import DTYPES, FORMATS, check_format, exporter_class, format_of
from ultragray.exchange.poses import load_poses
from ultragray.files import file_sha256
from ultragray.geometry.probe import FloatArray
from ultragray.rendering.settings import Encoding, FrameSettings, Resolved
from ultragray.samplers import Sampler, TrainingSampler, assessed_poses
from ultragray.samplers.confident import require_drawn
from ultragray.scene.confidence import CONTACT_SHARE, Assessor, Extrapolation, figure_arrays
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
    command_group,
    counted,
    examples,
    frames_in_words,
    is_folder_name,
    option,
    output_option,
    tell,
)

if TYPE_CHECKING:
    from ultragray.scene.gaussians import GaussianScene

SHARDS = "Shards"
SUFFIXES = tuple(one.suffix for one in FORMATS.values())
command_app = command_group()


@command_app.command(
    epilog=examples(
        "ultragray render liver.ugr -o frames.npz  # the training poses",
        "ultragray render liver.ugr -o pictures/ --poses path.npy  # a folder of PNGs",
        "ultragray render liver.ugr -o augmented.tar --sampler around --count 500 --translation-mm 3",
        "ultragray render liver.ugr -o labels.h5 --outputs bmode,labels --min-confidence 0.8",
        "ultragray render liver.ugr -o s3://frames/liver --sampler around --count 10000000 --on ray://head:10001",
    )
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
    task = Task.prepared(scene, poses, sampler, settings)
    sentence, document = render_frames(task, path, format, dtype=dtype, backend=backend, threads=threads)
    tell(sentence, document, as_json=json)


@contextlib.contextmanager
def _probe_as_an_option() -> Iterator[None]:
    """Tells of a probe as the command line calls it."""
    try:
        yield
    except InvalidProbe as error:
        raise InvalidProbe(f"--{error.detail}", field="probe") from None


def checked_format(output: Path, settings: FrameSettings, dtype: str | None, *, force: bool) -> str | None:
    """The format that the name of the output stands for; None for a folder of PNGs.

    Raises InvalidArgument for an output that cannot or may not be written, ExtraMissing where the format's package is
    not installed.
    """
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


@dataclass(frozen=True)
class Task:
    """Frames that are to be rendered, checked without a renderer."""

    scene_file: Path
    settings: Resolved
    sampler: Sampler | None
    base: FloatArray  # [P, 4, 4] mm, of which the sampler makes poses
    poses: FloatArray  # [C, 4, 4] mm
    extrapolations: Sequence[Extrapolation]  # [C]

    @classmethod
    def prepared(cls, scene_file: Path, pose_file: Path | None, sampler: Sampler | None, asked: FrameSettings) -> Task:
        """The task of a command line. Raises InvalidArgument and its kind, SceneFileInvalid."""
        given_poses = None if pose_file is None else load_poses(pose_file)
        header = read_header(scene_file)
        with _probe_as_an_option():
            settings = asked.resolved(header.info, Encoding.FLOAT32)
        base = header.training_poses if given_poses is None else given_poses
        if not len(base):
            raise InvalidArgument("--poses must be given: the scene holds no training poses", field="poses")
        if sampler is None and given_poses is None:
            sampler = TrainingSampler()
        assess = partial(Assessor(header.info, header.training_poses).assess, probe=settings.probe)
        found = assessed_poses(sampler, base, settings.probe, assess, settings.least_confidence)
        return cls(scene_file, settings, sampler, base, *found)

    def with_frames_assessed(self, scene: GaussianScene, backend: str) -> Task:
        """The same, whose sampler keeps to frames that have the least confidence, where poses alone were looked at."""
        from ultragray.exchange.rendering import assess_by_rendering

        if self.sampler is None or self.settings.least_confidence is None:
            return self
        probe = self.settings.probe
        assess = partial(Assessor(scene.info, scene.training_poses).assess, probe=probe)
        seen = assess_by_rendering(scene, self.settings, assess, backend=backend)
        poses, found = assessed_poses(self.sampler, self.base, probe, seen, self.settings.least_confidence)
        return replace(self, poses=poses, extrapolations=found)


def render_frames(
    task: Task, output: Path, format: str | None, *, dtype: str | None, backend: str, threads: int
) -> tuple[str, dict[str, Any]]:
    """Render and write; `format` None writes a folder of PNGs. What was written: a sentence, and a document.

    Raises InvalidArgument, SceneFileInvalid, BackendUnavailable, MemoryExceeded, OSError; a file is then not written.
    """
    import torch

    from ultragray.exchange.rendering import render_to_file
    from ultragray.rendering.backends.registry import render_device
    from ultragray.scene.gaussians import GaussianScene

    scene = GaussianScene.load(task.scene_file).to(render_device(backend))
    if threads:
        torch.set_num_threads(threads)
    started = time.perf_counter()
    task = task.with_frames_assessed(scene, backend)
    with counted("rendering", len(task.poses)) as report:
        found = render_to_file(
            output,
            format,
            scene,
            task.settings,
            task.poses,
            task.extrapolations,
            dtype=dtype,
            scene_name=task.scene_file.stem,
            scene_sha256=file_sha256(task.scene_file),
            backend=backend,
            before_portion=report,
        )
    seconds = time.perf_counter() - started
    figures = figure_arrays(found)
    confidence, supported = figures["confidence"], float(figures["supported_share"].mean())
    trust = [f"Gaussians support {supported:.0%} of the pixels"]
    document = {
        "output": str(output),
        "frames": len(found),
        "height": task.settings.height,
        "width": task.settings.width,
        "outputs": list(task.settings.outputs),
        "seconds": round(seconds, 3),
        "confidence_min": None,  # of a scene that does not know it
        "confidence_max": None,
        "supported_share": supported,
    }
    if CONTACT_SHARE in figures:
        document[CONTACT_SHARE] = float(figures[CONTACT_SHARE].mean())
        trust.append(f"{document[CONTACT_SHARE]:.0%} of the scan lines have contact")
    if np.isfinite(confidence).all():
        document |= {"confidence_min": float(confidence.min()), "confidence_max": float(confidence.max())}
        trust.insert(0, f"confidence {confidence.min():.2f} to {confidence.max():.2f}")
    size = f"{task.settings.height}x{task.settings.width}"
    what = f"{frames_in_words(len(found))} of {size}, {', '.join(task.settings.outputs)}"
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
    """The batch of a command line. Raises InvalidArgument and its kind, SceneFileInvalid."""
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
    """Render what is missing of a batch on a cluster, and write its manifest. A sentence and a document tell of it.

    Raises InvalidArgument for an output that is no folder or holds something else, and what `RayBatch.render` raises.
    """
    from ultragray_workers.batches.on_ray import RayBatch, check_address
    from ultragray_workers.storage.location import open_storage

    check_address(on)
    storage = open_storage(output)
    if storage.local is not None:
        folder = storage.local.resolve()
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
