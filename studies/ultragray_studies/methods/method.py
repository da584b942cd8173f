"""What a method is: how long it may learn (its budget), what it says of itself, and how it is fitted and renders.

- equal: as many seconds as the scene's preset `fast` took on the same machine. Before its first step a method is timed
  for a moment, and gets as many steps as fit; its schedules are stretched to that number.
- author: the steps that its author's recipe takes, however long that is.

A number of steps that follows from a clock would differ from run to run, and the table with it. So `Paces` keeps what
was measured: the same comparison on the same machine gets the same steps. The moment may have been a busy one, and
nobody is to lose by that: a fit that then takes a part of its time only is made again, with the pace that it showed.
"""

from __future__ import annotations

import contextlib
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ultragray.errors import InvalidArgument
from ultragray.files import write_whole
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.learn.evaluation.methods import BudgetKind
from ultragray.learn.sweep import Dataset, Sweep

USED_SHARE = 0.8  # of an equal time: a fit that took less was promised too few steps


@dataclass(frozen=True)
class Pace:
    """The speed of a method on a machine: seconds before its first step, and of each step."""

    start_s: float
    step_s: float
    is_confirmed: bool = True  # by a whole fit; else it was taken in a moment


class Paces:
    """What was measured on this machine, by method; in a file where there is one, so that a later run gets the same."""

    def __init__(self, path: Path | None = None, surroundings: Mapping[str, object] | None = None) -> None:
        """`surroundings`: what a measurement holds for (machine, threads, dataset); another one's is not looked at."""
        self._path = path
        self._section = json.dumps(dict(surroundings or {}), sort_keys=True)
        self._known: dict[str, Any] = {}
        if path is not None:
            with contextlib.suppress(OSError, ValueError, TypeError):  # then it is measured again
                self._known = dict(json.loads(path.read_text(encoding="utf-8")))

    def known(self, name: str) -> Pace | None:
        """What was measured of a method; None where nothing was, or the file is another's."""
        try:
            start_s, step_s, is_confirmed = self._known[self._section][name]
            return Pace(float(start_s), float(step_s), bool(is_confirmed))
        except (LookupError, TypeError, ValueError):
            return None

    def keep(self, name: str, pace: Pace) -> None:
        """Keeps what was measured; in a place that cannot be written, for this process only."""
        section = self._known.get(self._section)
        self._known[self._section] = {**(section if isinstance(section, dict) else {}), name: astuple(pace)}
        if self._path is not None:
            with contextlib.suppress(OSError):
                self._path.parent.mkdir(parents=True, exist_ok=True)
                write_whole(self._path, json.dumps(self._known, indent=1) + "\n")

    def confirm(self, name: str) -> None:
        """Keeps a pace for good, where there is one."""
        if (pace := self.known(name)) is not None and not pace.is_confirmed:
            self.keep(name, replace(pace, is_confirmed=True))

    def get(self, name: str, measure: Callable[[], Pace]) -> Pace:
        """What is known of a method, else what `measure` finds, which is kept."""
        pace = self.known(name)
        if pace is None or not pace.step_s > 0.0:
            self.keep(name, pace := measure())
        return pace


@dataclass(frozen=True)
class Budget:
    """What a fit may take. Raises InvalidArgument for an equal time that is not positive."""

    kind: BudgetKind
    seconds: float | None = None  # of an equal time
    paces: Paces = field(default_factory=Paces, compare=False)

    @classmethod
    def equal(cls, seconds: float, paces: Paces | None = None) -> Budget:
        if not 0.0 < seconds < float("inf"):
            raise InvalidArgument(f"seconds of an equal time must be positive, got {seconds}", field="seconds")
        return cls(BudgetKind.EQUAL, seconds, paces or Paces())

    @classmethod
    def author(cls) -> Budget:
        return cls(BudgetKind.AUTHOR)

    def steps(self, name: str, published: int, measure: Callable[[], Pace]) -> int:
        """The steps of a method: those of its author, or those that fit into the time, one at least."""
        if self.kind is BudgetKind.AUTHOR:
            return published
        assert self.seconds is not None
        pace = self.paces.get(name, measure)
        return max(1, int((self.seconds - pace.start_s) / pace.step_s))

    def shown_pace(self, name: str, steps: int, seconds: float) -> Pace | None:
        """The pace of a fit that used a part of its time only, by its steps and seconds; None for any other.

        Only of a pace that was taken in a moment: one that a fit has confirmed stays, for the same table.
        """
        pace = None if self.kind is BudgetKind.AUTHOR else self.paces.known(name)
        if pace is None or pace.is_confirmed:
            return None
        assert self.seconds is not None
        new_pace = Pace(pace.start_s, (seconds - pace.start_s) / steps, is_confirmed=False)
        return new_pace if seconds < USED_SHARE * self.seconds and 0.0 < new_pace.step_s < pace.step_s else None


# The protocol of a method: it is fitted to a sweep within a budget, and what was fitted predicts frames. All methods
# see the same training frames, at the same size, with the same poses; none sees a held-out frame.


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

    def ends_part(self, parts: int) -> bool:
        """Whether the step is the last of one of so many parts of the fit."""
        return self.step * parts // self.steps > (self.step - 1) * parts // self.steps


@dataclass(frozen=True)
class FitRun:
    """The surroundings of a fit; none of them changes what it learns on one thread of a CPU, but for the seed.

    `folder` keeps what a killed fit continues from, and afterwards the model: the same call finds it there. When
    `should_stop` turns true, the fit ends after the step at hand with a checkpoint.
    """

    folder: Path | None = None
    device: str = "cpu"  # cpu, cuda or cuda:N
    seed: int = 0
    report: Callable[[FitProgress], None] = lambda progress: None
    should_stop: Callable[[], bool] = lambda: False
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

    def predict(self, sweep: Sweep) -> FrameArray:
        """The frames [F, H, W] that it expects in the place of those of a sweep: at their poses."""
        return self.render(sweep.probe, sweep.poses, sweep.height, sweep.width)


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

    def predict_on_path(self, dataset: Dataset, placed: Dataset, fitted: Fitted) -> FrameArray | None:
        """The held-out frames that it expects where all frames lie on the path that neighbours agree with (`placed`).

        None where it has learned from the poses of the dataset.
        """
        return None
