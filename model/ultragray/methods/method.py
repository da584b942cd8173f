"""The protocol of a method: it is fitted to a sweep within a budget, and what was fitted predicts frames.

    method = METHODS["ultranerf-unit"]
    fitted = method.fit(dataset, Budget.equal(172.0))
    frames = fitted.render(dataset.probe, dataset.val.poses, 256, 128)  # [C, H, W] in [0, 1]

All methods see the same training frames, at the same size, with the same poses; none sees a held-out frame.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ultragray.datasets.sweep import Dataset
from ultragray.methods.budget import Budget
from ultragray.probe import FloatArray, Probe

FrameArray = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Description:
    """A method in words, for tables and pages. `equations` are plain text, in the notation of its concept page."""

    title: str
    source: str  # paper, with its identifier
    summary: str
    equations: tuple[str, ...] = ()
    choices: tuple[str, ...] = ()  # what its paper leaves open or this project does otherwise, and what was chosen
    published_steps: int | None = None  # of the author's recipe on its data; None: it learns nothing step by step


@dataclass(frozen=True)
class FitProgress:
    """The state of a fit after a step."""

    step: int  # steps done
    steps: int
    loss: float
    seconds_left: float


@dataclass(frozen=True)
class FitRun:
    """The surroundings of a fit; none of them changes what it learns on one thread of a CPU, but for the seed.

    `folder` keeps what a killed fit continues from, and afterwards the model: the same call finds it there. When
    `should_stop` turns true, the fit ends after the step at hand with a checkpoint.
    """

    folder: Path | None = None
    device: str = "cpu"  # cpu, cuda or cuda:N
    seed: int = 0
    report: Callable[[FitProgress], None] | None = None
    should_stop: Callable[[], bool] | None = None
    checkpoint_interval_s: float = 30.0


@dataclass(frozen=True)
class Cost:
    """The cost of a fit. `steps` is 0 where nothing is learned by steps, `of_steps` is the author's recipe."""

    seconds: float  # from the sweep in memory to a model that renders, on this machine
    steps: int
    of_steps: int | None
    model_bytes: int  # of the file that renders, without the state of its training

    @property
    def is_short(self) -> bool:
        """Whether it had fewer steps than its author's recipe: then it does not bear the method's bare name."""
        return self.of_steps is not None and self.steps < self.of_steps


class Fitted(ABC):
    """A method after its fit."""

    cost: Cost

    @abstractmethod
    def render(self, probe: Probe, poses: FloatArray, height: int, width: int) -> FrameArray:
        """The frames [C, H, W] in [0, 1] that it expects at poses [C, 4, 4] (mm, probe→tracker)."""


class Method(ABC):
    """A way from a tracked sweep to frames of other poses. `name` is what the command line calls it."""

    name: str

    @abstractmethod
    def describe(self) -> Description: ...

    @abstractmethod
    def fit(self, dataset: Dataset, budget: Budget, run: FitRun | None = None) -> Fitted | None:
        """Fits to `dataset.train`; None where it was told to stop.

        Raises DatasetInvalid, MemoryExceeded, TrainingDiverged, TrainingStateInvalid for a folder of another fit.
        """
