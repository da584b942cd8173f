"""The work of a render job: frames of a scene become one archive. Interrupted, it begins anew."""

from __future__ import annotations

import shutil
import sys
from dataclasses import replace
from pathlib import Path
from statistics import fmean

from ultragray.exchange.rendering import assess_by_rendering, render_portions, render_to_file
from ultragray.files import file_sha256, write_whole
from ultragray.geometry.probe import FloatArray
from ultragray.learn.sweep import spread_places
from ultragray.learn.training.memory import training_device
from ultragray.rendering.limits import Limits
from ultragray.rendering.outputs import OUTPUTS
from ultragray.rendering.pixels import png_file, to_uint8
from ultragray.rendering.settings import Encoding, Resolved
from ultragray.samplers import Assess
from ultragray.scene.confidence import Assessor, Extrapolation
from ultragray.scene.gaussians import GaussianScene
from ultragray.scene.info import SceneHeader, read_header
from ultragray_workers.jobs.kinds import shards_run
from ultragray_workers.jobs.kinds.render import RenderJob
from ultragray_workers.jobs.progress import Outcome
from ultragray_workers.jobs.worker.job_run import JobRun, Stopped
from ultragray_workers.scene_names import SUFFIX

EXAMPLES, EXAMPLE_SIDE = 6, 256  # pictures; pixels of the longer side
ASSESSED_AT_ONCE = 100_000  # poses times training poses, of about a tenth of a second


def run(job_run: JobRun, job: RenderJob) -> Outcome:
    """Renders all poses into `frames` with the suffix of the format, and a few of them as pictures beside it.

    The metrics tell the least, mean and greatest confidence of the frames, where the scene knows any. Raises Stopped,
    InvalidArgument, LowConfidence, InvalidProbe, FrameTooCostly, SceneFileInvalid, StorageFull, ExtraMissing.
    """
    if job.is_sharded:
        return shards_run.run(job_run, job)
    device = training_device(job_run.request.device, "auto")
    path = job_run.folder.path / f"{job.scene}{SUFFIX}"
    header = read_header(path)
    settings = job.resolved(header.info, Encoding.FLOAT32)
    limits = Limits(job_run.request.max_footprint_pixels)
    scene = GaussianScene.load(path).to(device)
    assess = _assessing(job_run, header, settings)
    if job.sampler is not None:
        assess = assess_by_rendering(scene, settings, assess, limits=limits)
    poses, extrapolations = job.assessed_poses(header.training_poses, settings.probe, assess)
    free = shutil.disk_usage(job_run.folder.path).free
    job.check_room(len(poses), job.file_format.shown(settings).picture, free)
    size = f"{settings.height}x{settings.width}"
    sys.stderr.write(f"rendering {len(poses):,} frames of {size} of {job.scene} on {device}\n")
    with job_run.folder.new_artifacts() as folder:
        name = f"frames{job.file_format.suffix}"
        assessments, sha256 = render_to_file(
            folder / name,
            job.file_format.name,
            scene,
            settings,
            poses,
            extrapolations,
            dtype=job.dtype,
            scene_name=job.scene,
            scene_sha256=file_sha256(path),
            limits=limits,
            before_portion=job_run.counter(len(poses)),
        )
        _write_examples(folder, scene, settings, poses, assessments, limits)
    confidences = [one.confidence for one in assessments if one.confidence is not None]
    metrics = {}
    if confidences:
        least, mean, greatest = min(confidences), fmean(confidences), max(confidences)
        metrics = {"least_confidence": least, "mean_confidence": mean, "greatest_confidence": greatest}
    hashes = {} if sha256 is None else {name: sha256}
    return Outcome(artifacts=job_run.folder.artifact_names(), metrics=metrics, sha256=hashes)


def _write_examples(
    folder: Path,
    scene: GaussianScene,
    settings: Resolved,
    poses: FloatArray,  # [C, 4, 4] mm
    extrapolations: list[Extrapolation],  # [C]
    limits: Limits,
) -> None:
    """A few frames, evenly spread, as pictures true to scale: what one looks at before one loads them all."""
    places = spread_places(len(poses), EXAMPLES)
    pixel_mm = settings.display.pixel_mm or settings.probe.box_mm.longer_side / EXAMPLE_SIDE
    view = replace(settings, outputs=settings.outputs[:1], display=replace(settings.display, pixel_mm=pixel_mm))
    portions = render_portions(scene, view, poses[places], [extrapolations[at] for at in places], limits=limits)
    (name,) = view.outputs
    pictures = (picture for frames, _ in portions for picture in frames[name])
    for place, picture in zip(places, pictures, strict=True):
        write_whole(folder / f"example_{place:05d}.png", png_file(to_uint8(OUTPUTS[name].shares(picture))))


def _assessing(job_run: JobRun, header: SceneHeader, settings: Resolved) -> Assess:
    """A function that tells how far poses extrapolate, until the job is to stop."""
    assessor = Assessor(header.info, header.training_poses)
    at_once = max(1, ASSESSED_AT_ONCE // max(1, len(header.training_poses)))

    def assess(poses: FloatArray) -> list[Extrapolation]:  # [C, 4, 4] -> [C]
        extrapolations: list[Extrapolation] = []
        for first in range(0, len(poses), at_once):
            if job_run.should_stop():
                raise Stopped
            extrapolations.extend(assessor.assess(poses[first : first + at_once], settings.probe, phase=settings.phase))
        return extrapolations

    return assess
