"""The kinds of jobs. A new kind is a module with its specification, one with its work, and a line here. Free of torch.

Modules that end in `_run` do the work of a kind and are imported in the job's process only.
"""

from ultragray_workers.jobs.kinds.base import Specification
from ultragray_workers.jobs.kinds.evaluate import CompareJob, EvaluateJob
from ultragray_workers.jobs.kinds.live import LiveJob
from ultragray_workers.jobs.kinds.motion import MotionJob
from ultragray_workers.jobs.kinds.render import RenderJob
from ultragray_workers.jobs.kinds.train import TrainJob
from ultragray_workers.jobs.kinds.voxelize import VoxelizeJob

__all__ = [
    "KINDS",
    "CompareJob",
    "EvaluateJob",
    "LiveJob",
    "MotionJob",
    "RenderJob",
    "Specification",
    "TrainJob",
    "VoxelizeJob",
]

KINDS = tuple(Specification.members)
