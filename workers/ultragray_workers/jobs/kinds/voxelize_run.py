"""The work of a voxelization: a field of a scene, written layer by layer. Interrupted, it begins anew."""

from __future__ import annotations

import json
import sys

from ultragray.files import file_sha256
from ultragray.rendering.volume_fields import volume_facts, write_volume
from ultragray.scene.gaussians import GaussianScene
from ultragray_workers.jobs.kinds.voxelize import VoxelizeJob
from ultragray_workers.jobs.progress import Outcome
from ultragray_workers.jobs.worker.job_run import JobRun
from ultragray_workers.scene_names import SUFFIX

FACTS_FILE = "volume.json"


def run(job_run: JobRun, job: VoxelizeJob) -> Outcome:
    """Writes the volume and volume.json; a frame of its progress is a layer of voxels.

    Raises Stopped, InvalidArgument, SceneFileInvalid, OSError.
    """
    path = job_run.folder.path / f"{job.scene}{SUFFIX}"
    scene = GaussianScene.load(path)
    grid = job.grid(scene.info)
    sys.stderr.write(f"sampling {job.field} of {job.scene} at {' x '.join(map(str, grid.shape))} points\n")
    facts = {"scene": job.scene, "scene_sha256": file_sha256(path), **volume_facts(scene.info, job.field, grid)}
    with job_run.folder.new_artifacts() as folder:
        write_volume(folder / job.file_name, scene, job.field, grid, after_slab=job_run.counter(grid.shape[2]))
        document = json.dumps({"file": job.file_name, **facts}, indent=1) + "\n"
        (folder / FACTS_FILE).write_text(document, encoding="utf-8")
    return Outcome(artifacts=job_run.folder.artifact_names())
