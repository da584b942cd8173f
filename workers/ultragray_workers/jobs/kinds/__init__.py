"""The kinds of jobs. A new kind is a module with its specification, one with its work, and a line here. Free of torch.

Modules that end in `_run` do the work of a kind and are imported in the job's process only.
"""

from .base import Specification
from .compare import CompareJob
from .evaluate import EvaluateJob
from .render import RenderJob
from .train import TrainJob
from .volumes.voxelize import VoxelizeJob

__all__ = ["KINDS", "CompareJob", "EvaluateJob", "RenderJob", "Specification", "TrainJob", "VoxelizeJob"]

KINDS = tuple(Specification.members)
