"""Sweeps of the built-in phantom that leave something out, and the frames that were left out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from ultragray import LinearProbe, Probe
from ultragray.geometry.probe import FloatArray
from ultragray.learn.sweep import Sweep
from ultragray.phantom import PHANTOM_PROBE, freehand_poses, simulate

SIDE = 128
FIRST_MM = -36.0  # where the sweeps begin


@dataclass(frozen=True, eq=False)
class Case:
    """What a scene is trained from, and frames that it has not seen, each with the cause for which it is predicted."""

    training: Sweep
    unseen: Sweep
    causes: np.ndarray  # [F] of tilt, steep, gap, end, band, random


@dataclass(frozen=True)
class Mixture:
    """A training set: sweeps of `count` frames at `tilts`, without `gaps` and what lies beyond `end_mm`."""

    seed: int
    tilts: tuple[float, ...]
    count: int
    gaps: tuple[tuple[float, float], ...]
    end_mm: float
    over_mm: float = 10.0  # how far beyond frames are asked for
    first_mm: float = FIRST_MM

    def case(self) -> Case:
        """Frames of new sweeps: tilts of −10° … 10° and ±18°, within the gaps, and off the end."""
        generator = np.random.default_rng(self.seed)

        def sweep(count: int, tilt_deg: float) -> FloatArray:
            offset_mm, unrest = generator.uniform(-2.0, 2.0), generator.uniform(0.0, 6.0)
            return freehand_poses(count, tilt_deg=tilt_deg, offset_mm=offset_mm, unrest=unrest)

        def some(poses: FloatArray, chosen: np.ndarray, count: int) -> FloatArray:
            return poses[generator.choice(np.flatnonzero(chosen), count, replace=False)]

        trained, unseen, causes = [], [], []
        for tilt in self.tilts:
            poses = sweep(self.count, tilt)
            trained.append(poses[self._is_trained(poses)])
        for tilt in np.linspace(-10.0, 10.0, 9):
            poses = sweep(300, float(tilt))
            unseen.append(some(poses, self._is_trained(poses), 5))
            causes += ["tilt"] * 5
        for cause, sweeps in (("gap", 6), ("end", 5)):
            for _ in range(sweeps):
                poses = sweep(600, float(generator.choice(self.tilts)))
                along = poses[:, 1, 3]
                beyond = (along > self.end_mm) & (along < self.end_mm + self.over_mm)
                unseen.append(some(poses, self._in_gap(along) if cause == "gap" else beyond, 6))
                causes += [cause] * 6
        for tilt in (-18.0, 18.0):
            poses = sweep(300, tilt)
            unseen.append(some(poses, self._is_trained(poses), 10))
            causes += ["steep"] * 10
        return simulated(np.concatenate(trained), np.concatenate(unseen), np.array(causes))

    def _is_trained(self, poses: FloatArray) -> np.ndarray:
        along = poses[:, 1, 3]
        return (along >= self.first_mm) & (along <= self.end_mm) & ~self._in_gap(along)

    def _in_gap(self, along: FloatArray) -> np.ndarray:
        return np.any([(along > low) & (along < high) for low, high in self.gaps], axis=0)


def simulated(trained: FloatArray, unseen: FloatArray, causes: np.ndarray, probe: Probe = PHANTOM_PROBE) -> Case:
    """Frames of the phantom at both."""
    poses = np.concatenate([trained, unseen])
    images = simulate(poses, probe=probe, height=SIDE, width=SIDE)
    sweep = Sweep(images, poses, probe, np.arange(len(poses)), "phantom")
    count = len(trained)
    return Case(sweep.select(np.arange(count)), sweep.select(np.arange(count, len(poses))), causes)


def fourth_tilt(trained: tuple[float, ...], tilt_deg: float) -> Case:
    """Three sweeps at three tilts, and a fourth at another."""
    sweeps = [
        freehand_poses(20, tilt_deg=tilt, offset_mm=0.7 * place, unrest=place) for place, tilt in enumerate(trained)
    ]
    others = freehand_poses(24, tilt_deg=tilt_deg, offset_mm=1.5, unrest=3.3)
    return simulated(np.concatenate(sweeps), others, np.array(["steep"] * len(others)))


def robot(middle_mm: float) -> Case:
    """120 parallel frames 0.35 mm apart, of which every fifth and a band of 3.5 mm are held out."""
    numbers = np.arange(120)
    poses = np.tile(np.eye(4), (120, 1, 1))
    poses[:, 1, 3] = middle_mm + 0.35 * (numbers - 59.5)
    band = (numbers >= 66) & (numbers < 76)
    held_out = band | (numbers % 5 == 2)
    causes = np.where(band, "band", "random")[held_out]
    return simulated(poses[~held_out], poses[held_out], causes, LinearProbe(40.0, 0.0, 40.0))


IN_SILICO: dict[str, Callable[[], Case]] = {
    "two tilts": Mixture(101, (-3.0, 3.0), 41, ((-22.0, -15.0), (2.0, 7.0)), 22.0, over_mm=12.0).case,
    "one sweep": Mixture(102, (0.0,), 46, ((-26.0, -20.0), (-8.0, -4.0), (10.0, 15.0)), 27.0).case,
    "three tilts": Mixture(103, (-6.0, 0.0, 6.0), 30, ((-10.0, -2.0), (6.0, 10.0)), 18.0, first_mm=-30.0).case,
    "one side": Mixture(104, (0.0, 4.0), 36, ((-28.0, -24.0), (-16.0, -9.0), (4.0, 7.0)), 25.0).case,
    "fourth tilt +6°": partial(fourth_tilt, (-18.0, -6.0, 18.0), 6.0),
    "fourth tilt +18°": partial(fourth_tilt, (-18.0, -6.0, 6.0), 18.0),
    "robot": partial(robot, 0.0),
    "robot, elsewhere": partial(robot, -22.0),
}
