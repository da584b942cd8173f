"""The work of a render job: frames of a scene become one archive. Interrupted, it begins anew."""

from __future__ import annotations

import shutil
import sys

from ultragray.exchange.rendering import assess_by_rendering, render_to_file
from ultragray.files import file_sha256
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.learn.training.memory import training_device
from ultragray.rendering.limits import Limits
from ultragray.rendering.settings import Encoding
from ultragray.samplers import Assess
from ultragray.scene.confidence import Assessor, Extrapolation
from ultragray.scene.gaussians import GaussianScene
from ultragray.scene.info import SceneHeader, read_header
from ultragray_workers.jobs.kinds import shards_run
from ultragray_workers.jobs.kinds.render import RenderJob
from ultragray_workers.jobs.progress import Outcome
from ultragray_workers.jobs.worker.job_run import JobRun, Stopped
from ultragray_workers.scene_names import SUFFIX

ASSESSED_AT_ONCE = 100_000  # poses times training poses, of about a tenth of a second


def run(job_run: JobRun, job: RenderJob) -> Outcome:
    """Renders all poses into `frames` with the suffix of the format.

    Raises Stopped, InvalidArgument, LowConfidence, InvalidProbe, FrameTooCostly, SceneFileInvalid, StorageFull,
    ExtraMissing.
    """
    if job.is_sharded:
        return shards_run.run(job_run, job)
    device = training_device(job_run.request.device, "auto")
    path = job_run.folder.path / f"{job.scene}{SUFFIX}"
    described = read_header(path)
    settings = job.resolved(described.info, Encoding.FLOAT32)
    limits = Limits(job_run.request.max_footprint_pixels)
    scene = GaussianScene.load(path).to(device)
    assess = _assessing(job_run, described, settings.probe)
    if job.sampler is not None:
        assess = assess_by_rendering(scene, settings, assess, limits=limits)
    poses, extrapolations = job.assessed_poses(described.training_poses, settings.probe, assess)
    free = shutil.disk_usage(job_run.folder.path).free
    job.check_room(len(poses), job.file_format.shown(settings).picture, free)
    size = f"{settings.height}x{settings.width}"
    sys.stderr.write(f"rendering {len(poses):,} frames of {size} of {job.scene} on {device}\n")
    with job_run.folder.new_artifacts() as folder:
        render_to_file(
            folder / f"frames{job.file_format.suffix}",
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
    return Outcome(artifacts=job_run.folder.artifact_names())


def _assessing(job_run: JobRun, described: SceneHeader, probe: Probe) -> Assess:
    """A function that tells how far poses extrapolate, until the job is to stop."""
    assessor = Assessor(described.info, described.training_poses)
    at_once = max(1, ASSESSED_AT_ONCE // max(1, len(described.training_poses)))

    def assess(poses: FloatArray) -> list[Extrapolation]:  # [C, 4, 4] -> [C]
        found: list[Extrapolation] = []
        for first in range(0, len(poses), at_once):
            if job_run.should_stop():
                raise Stopped
            found.extend(assessor.assess(poses[first : first + at_once], probe=probe))
        return found

    return assess
