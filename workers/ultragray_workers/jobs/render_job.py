"""The work of a render job: frames of a scene become one archive. Interrupted, it begins anew."""

from __future__ import annotations

import sys
import time

import torch

from ultragray.evaluation import frames_at_once
from ultragray.files import file_sha256
from ultragray.rendering import render as render_frames
from ultragray.rendering import renderer_name
from ultragray.scene import GaussianScene
from ultragray.scene_info import read_header
from ultragray.training.device import training_device

from ..scenes import SUFFIX
from .archive import ARCHIVES, ArchiveHeader
from .folder import Outcome, Progress
from .poses import poses_of
from .specification import RenderJob
from .work import Stopped, Work


def render(work: Work, job: RenderJob) -> Outcome:
    """Renders all poses into `frames.npz` or `frames.tar`. Raises Stopped, InvalidProbe, SceneFileInvalid."""
    from .train_job import chosen_device

    torch.set_num_threads(work.request.threads)
    path = work.folder.path / f"{job.scene}{SUFFIX}"
    poses = poses_of(job, read_header(path).training_poses)
    device = training_device(chosen_device("auto", work.request.device), "auto")
    scene = GaussianScene.load(path).to(device)
    height, width = scene.info.image_size_or(job.height, job.width)
    header = ArchiveHeader(
        outputs=job.outputs,
        poses=poses,
        height=height,
        width=width,
        scene=job.scene,
        scene_sha256=file_sha256(path),
        renderer=renderer_name("auto", scene),
    )
    sys.stderr.write(f"rendering {len(poses):,} frames of {height}x{width} of {job.scene} on {device}\n")
    at_once = frames_at_once(height, width)
    started = time.monotonic()
    with work.folder.new_artifacts() as folder:
        archive = ARCHIVES[job.format](folder / f"frames.{job.format}", header)
        work.report(Progress(frames_done=0, frames=len(poses)))
        for first in range(0, len(poses), at_once):
            if work.should_stop():
                raise Stopped
            with torch.no_grad():
                frames = render_frames(
                    scene, None, poses[first : first + at_once], height=height, width=width, outputs=job.outputs
                )
            archive.add({name: getattr(frames, name).cpu().numpy() for name in job.outputs})
            done = min(first + at_once, len(poses))
            rate = done / (time.monotonic() - started)
            work.report(
                Progress(frames_done=done, frames=len(poses), rate_per_s=rate, seconds_left=(len(poses) - done) / rate)
            )
        archive.close()
    return Outcome(artifacts=work.folder.artifact_names())
