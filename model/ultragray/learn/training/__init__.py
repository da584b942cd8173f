"""Training: a tracked sweep becomes a scene.

`train` is imported on first use, so that a configuration needs no torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ultragray.learn.training.config import TrainingConfig
from ultragray.learn.training.progress import Progress

if TYPE_CHECKING:
    from ultragray.learn.training.run import train


__all__ = ["Progress", "TrainingConfig", "train"]


def __getattr__(name: str) -> Any:
    if name == "train":
        from ultragray.learn.training.run import train

        globals()[name] = train
        return train
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
