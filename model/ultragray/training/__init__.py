"""Training: a tracked sweep becomes a scene."""

from .config import TrainingConfig
from .progress import Progress
from .trainer import train

__all__ = ["Progress", "TrainingConfig", "train"]
