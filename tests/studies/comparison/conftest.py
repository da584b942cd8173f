"""A sweep and methods that are small enough to compare in a moment."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

from ultragray.errors import MemoryExceeded
from ultragray_studies.comparison.run import EQUAL_TIME
from ultragray_studies.methods.classical import Compounding, FromFrames
from ultragray_studies.methods.gaussians import SceneMethod
from ultragray_studies.methods.method import Description, Method, Pace, Paces

from ...model.learn.conftest import make_tiny_dataset
from ..methods.conftest import MeanImage


@pytest.fixture
def dataset():
    return replace(make_tiny_dataset(frames=16, height=16, width=16), name="50 % of <tiny>")


@dataclass(frozen=True)
class LevelMethod(MeanImage):
    """It learns one image, in two hundred steps where its author has time. Counts its fits."""

    name: str = "level"
    fits: list[Path | None] = field(default_factory=list, compare=False)

    def describe(self):
        return Description("one level", "a test & no paper", "Grey.", ("B = g_0",), ("g from 0.",), 200)

    def fit(self, dataset, budget, run=None):
        self.fits.append(None if run is None else run.folder)
        return super().fit(dataset, budget, run)


class FailingMethod(Method):
    """It never fits into memory."""

    name = "failing"

    def describe(self):
        return Description("one that fails", "a test", "Nothing.")

    def fit(self, dataset, budget, run=None):
        raise MemoryExceeded("it needs 9 GB & more")


@pytest.fixture
def scene_method():
    return SceneMethod(settings={"steps": 4, "max_gaussians": 40, "batch_size": 2})


@pytest.fixture
def level():
    return LevelMethod()


@pytest.fixture
def methods(scene_method, level):
    found = (scene_method, Compounding("median"), FromFrames("nearest"), level, FailingMethod())
    return {method.name: method for method in found}


@pytest.fixture
def paces():
    """A machine on which the equal time holds 40 steps of the learned method, whatever the clock says."""
    paces = Paces()
    paces.keep(EQUAL_TIME, Pace(2.0, 0.0))
    paces.keep("level", Pace(0.0, 0.05))
    return paces
