"""What a render job asks of its scene and of the disk, checked when it is submitted. Free of torch."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from ultragray.confidence import Assessor, require_confidence
from ultragray.files.atomic import sync
from ultragray.interchange.exports import check_format
from ultragray.outputs import OUTPUTS
from ultragray.scene_info import SceneHeader, read_header
from ultragray.settings import Encoding, FrameSettings

from ..claims import storage_full
from ..errors import StorageFull
from ..scenes import SUFFIX, SceneStore
from .folder import JobFolder
from .link import link_or_copy
from .poses import poses_of
from .specification import RenderJob

_MB, _GB = 1e6, 1e9
ASSESSED_AT_ONCE = 250_000  # poses times training poses that submissions wait for: about a fifth of a second


def keep_scene(
    job: RenderJob, folder: JobFolder, scenes: SceneStore, before: JobFolder | None, max_image_side: int
) -> None:
    """Puts the scene as it is now into the folder of the job, once the job can be done.

    `before`: the folder of the job that it replaces, whose scene is taken where it is still there. Raises
    SceneNotFound, SceneFileInvalid, StorageFull and what `check_rendering` raises.
    """
    name = f"{job.scene}{SUFFIX}"
    old = None if before is None else before.path / name
    if old is not None and old.is_file():
        scene, header = old, read_header(old)
    else:
        scene, header = scenes.path(job.scene), scenes.header(job.scene)
    with storage_full("the scene of the job"):
        check_rendering(job, header, max_image_side, folder.artifact_folder)
        folder.path.mkdir(parents=True, exist_ok=True)
        sync(folder.path.parent)
        new = folder.path / f".{name}"
        try:
            new.unlink(missing_ok=True)
            link_or_copy(scene, new)
        except FileNotFoundError:
            scenes.path(job.scene)  # says that it is gone
            raise
        new.replace(folder.path / name)  # a submission that failed may have left another scene
        new.unlink(missing_ok=True)  # or the same
        sync(folder.path)


def check_rendering(job: RenderJob, scene: SceneHeader, max_image_side: int, artifact_folder: Path) -> None:
    """Raises what a job that cannot be done would end with: UnknownOutput, InvalidProbe, InvalidImageSize,
    InvalidArgument for a sampler without use for the poses or a `min_confidence` that the scene cannot tell,
    LowConfidence for a given pose below it, unless there are too many to look at each, StorageFull for more pixels than
    the disk has room for.
    """
    asked = FrameSettings(height=job.height, width=job.width, outputs=job.outputs, min_confidence=job.min_confidence)
    settings = asked.resolved(scene.info, Encoding.FLOAT32, max_image_side=max_image_side)
    poses = poses_of(job, scene.training_poses, settings.probe)
    frames = len(poses)
    few = frames * len(scene.training_poses) <= ASSESSED_AT_ONCE
    if job.min_confidence is not None and job.sampler is None and few:
        require_confidence(Assessor(scene.info, scene.training_poses).assess(poses), job.min_confidence)
    needed = frames * settings.height * settings.width * _pixel_bytes(job)
    free = shutil.disk_usage(artifact_folder).free
    if needed > free:
        raise StorageFull(
            f"{frames:,} frames of {settings.height}x{settings.width} take up to {_size(needed)}, "
            f"the artifact folder has {_size(free)} left",
            field="poses" if job.sampler is None else "sampler",
        )


def _pixel_bytes(job: RenderJob) -> int:
    dtype = np.dtype(check_format(job.format, job.outputs, job.dtype))
    return sum(1 if OUTPUTS[name].is_numbers else dtype.itemsize for name in job.outputs)


def _size(size_bytes: int) -> str:
    return f"{size_bytes / _MB:,.0f} MB" if size_bytes < _GB else f"{size_bytes / _GB:,.1f} GB"
