"""Where a probe will be a moment after its newest pose: a prediction from the poses and stamps of its path.

A path is its position, mm along the scene's axes, and its turns, rad about the probe's own axes, added up from pose to
pose. Polynomials in time are fitted to the last poses of it: of degrees 1 to 3, each with weights that fall off
exponentially with age, over several spans. What a hand, a robot and a tracker's noise call for is not assumed: each
prediction is held against the path once its time has come, and the polynomial that would have come closest is taken.
For the motion m that it foretells and the motion y that came true, both from the newest pose of that time on,

    α = Σ m·y / Σ m·m, from 0 to 1

is the share of the foretold motion to believe in. It is 0 where nothing can be foretold (the probe rests, or turns
back all the time), so that the prediction is no worse than the newest pose, as far as the path goes on as before.
Positions and turns have shares of their own. The root of what is left of Σ |y − αm|² is the error to expect.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ultragray.contract import described
from ultragray.geometry.probe import FloatArray
from ultragray.geometry.rotations import rotations_of, turns_of

MAX_AHEAD_MS = 1000.0
_POSES = 64  # that a fit looks at
_SPANS = (1.5, 3.0, 6.0, 12.0, 24.0)  # of a fit, in steps between poses: after so many a pose weighs 1/e
_DEGREES = (1, 2, 3)
_ATTEMPTS = 1024  # that wait for their time: more poses than come in a second, or one that is sent again and again
_MEMORY_S = 3.0  # after which a prediction that was tried counts 1/e
_DOUBT = 2.0  # predictions that came to nothing, which are assumed before any was tried
_GAP_S = 1.0  # without poses: the path begins anew
_LATE = 3  # poses in a row that are older than the newest
_MOST = np.array([30.0, np.radians(30.0)])  # mm, rad, that a pose is foretold to move
_JUMP = np.array([30.0, np.radians(30.0)])  # mm, rad off a steady motion: a tracker's jump, likewise
_RIDGE = 1e-9  # of the normal equations, whose weights are at most 1
_TINY = 1e-12


@dataclass(frozen=True)
class Prediction:
    """How far ahead of its measured pose a frame is, and how wrong its pose is expected to be (root mean square)."""

    ahead_ms: float = described("From the time of the newest pose to that of the frame.")
    error_mm: float | None = described("Of the position; null: too few poses have come to tell.")
    error_deg: float | None = described("Of the rotation, likewise.")


class _Attempt(NamedTuple):
    """What was foretold of a time that is yet to come."""

    time_s: float
    place: FloatArray  # [2, 3] of the newest pose then
    motions: FloatArray  # [K, 2, 3] by each fit


class Stamps:
    """Times of the poses of a path, in seconds. They rise, but for a late pose now and then, and for a clock that is
    set back.
    """

    def __init__(self) -> None:
        self._newest_s = -math.inf
        self._late = 0  # in a row

    def begin_anew(self, time_s: float) -> bool:
        """Takes the next time; whether the clock was set back: it lies far before the newest, or a few in a row do."""
        self._late = self._late + 1 if time_s < self._newest_s else 0
        is_set_back = self._late >= _LATE or time_s < self._newest_s - _GAP_S
        if is_set_back or not self._late:
            self._newest_s, self._late = time_s, 0
        return is_set_back


class PathPredictor:
    """Poses [4, 4] (mm) of one path in, with their times in seconds of any clock; predictions out."""

    def __init__(self) -> None:
        self._degrees, self._spans = (grid.ravel() for grid in np.meshgrid(_DEGREES, _SPANS))  # [K] each
        self._pose = np.eye(4)  # the newest
        self._stamps = Stamps()
        self._times_s: deque[float] = deque(maxlen=_POSES)
        self._places: deque[FloatArray] = deque(maxlen=_POSES)  # [2, 3] each: position, and turns added up
        self._attempts: deque[_Attempt] = deque(maxlen=_ATTEMPTS)
        # Over the attempts whose time has come, by fit and for position and turn: Σ m·m, Σ m·y; and Σ y·y.
        self._foretold, self._agreed = np.zeros((2, len(self._degrees), 2))
        self._moved = np.zeros(2)
        self._count = 0.0

    def observe(self, time_s: float, pose: FloatArray) -> None:
        """Takes a measured pose, in the place of another of the same time. A late one, older than the newest, is left
        out.
        """
        if self._stamps.begin_anew(time_s) or not self._times_s:
            self._begin(time_s, pose)
            return
        after_s = time_s - self._times_s[-1]
        if after_s < 0.0:
            return
        step = np.stack([pose[:3, 3] - self._pose[:3, 3], turns_of(self._pose[:3, :3].T @ pose[None, :3, :3])[0]])
        if after_s == 0.0 and not (np.linalg.norm(step, axis=1) > _JUMP).any():
            self._pose, self._places[-1] = pose, self._places[-1] + step
            return
        if after_s == 0.0 or after_s > _GAP_S or self._is_jump(step, after_s):
            self._begin(time_s, pose)
            return
        self._pose = pose
        self._times_s.append(time_s)
        self._places.append(self._places[-1] + step)
        self._judge()

    def predict(self, time_s: float) -> tuple[FloatArray, Prediction]:
        """The pose [4, 4] at a time of the same clock, after the newest pose; at most MAX_AHEAD_MS after it.

        A pose must have been observed.
        """
        ahead_s = min(max(time_s - self._times_s[-1], 0.0), MAX_AHEAD_MS / 1e3)
        motions = self._motions(ahead_s)
        self._attempts.append(_Attempt(self._times_s[-1] + ahead_s, self._places[-1], motions))
        shares = np.clip(self._agreed / (self._foretold * (1.0 + _DOUBT / max(self._count, _TINY)) + _TINY), 0.0, 1.0)
        shares[len(self._times_s) <= self._degrees] = 0.0  # of a path that has just begun anew
        squares = self._moved - 2.0 * shares * self._agreed + shares**2 * self._foretold  # [K, 2]
        best, parts = squares.argmin(axis=0), np.arange(2)
        shift, turn = shortened(shares[best, parts, None] * motions[best, parts], _MOST)
        pose = self._pose.copy()
        pose[:3, 3] += shift
        pose[:3, :3] @= rotations_of(turn[None])[0]
        if not self._count:
            return pose, Prediction(round(1e3 * ahead_s, 3), None, None)
        position, rotation = np.sqrt(np.maximum(squares.min(axis=0), 0.0) / self._count)
        return pose, Prediction(
            round(1e3 * ahead_s, 3), round(float(position), 3), round(float(np.degrees(rotation)), 3)
        )

    def _begin(self, time_s: float, pose: FloatArray) -> None:
        self._pose = pose
        self._times_s.clear()
        self._places.clear()
        self._attempts.clear()
        self._times_s.append(time_s)
        self._places.append(np.stack([pose[:3, 3], np.zeros(3)]))

    def _is_jump(self, step: FloatArray, after_s: float) -> bool:  # [2, 3]
        if len(self._times_s) < 2:
            return False
        steady = (self._places[-1] - self._places[-2]) * after_s / (self._times_s[-1] - self._times_s[-2])
        return bool((np.linalg.norm(step - steady, axis=1) > _JUMP).any())

    def _motions(self, ahead_s: float) -> FloatArray:  # [K, 2, 3]
        """The motion from the newest pose on, by each fit: zero where too few poses have come for its degree.

        Coefficients c of the powers u⁰ … u³ of time in spans solve (Vᵀ W V) c = Vᵀ W y, all fits at once: powers above
        a fit's degree are left out by zeros, beside ones on the diagonal.
        """
        if len(self._times_s) <= min(_DEGREES):
            return np.zeros((len(self._degrees), 2, 3))
        times, places = np.array(self._times_s), np.array(self._places)
        spans_s = self._spans * (times[-1] - times[0]) / (len(times) - 1)
        is_used = np.arange(max(_DEGREES) + 1) <= self._degrees[:, None]  # [K, 4]
        ages = (times - times[-1]) / spans_s[:, None]  # [K, N], at most 0
        values = _powers(ages) * is_used[:, None]  # [K, N, 4]
        weighted = (np.exp(ages)[..., None] * values).transpose(0, 2, 1)
        normal = weighted @ values + (_RIDGE + ~is_used[:, None]) * np.eye(is_used.shape[1])
        coefficients = np.linalg.solve(normal, weighted @ (places - places[-1]).reshape(-1, 6))  # [K, 4, 6]
        ahead = _powers(ahead_s / spans_s) * is_used
        motions: FloatArray = (ahead[:, None] @ coefficients).reshape(-1, 2, 3)
        motions[len(times) <= self._degrees] = 0.0
        return motions

    def _judge(self) -> None:
        """Holds what was foretold of the times up to now against the path, which is straight between two poses."""
        (before_s, now_s), (before, now) = list(self._times_s)[-2:], list(self._places)[-2:]
        while self._attempts and self._attempts[0].time_s <= now_s:
            attempt = self._attempts.popleft()
            share = max((attempt.time_s - before_s) / (now_s - before_s), 0.0)
            motion = (1.0 - share) * before + share * now - attempt.place  # [2, 3]
            kept = np.exp((before_s - now_s) / _MEMORY_S)
            self._foretold = kept * self._foretold + (attempt.motions**2).sum(axis=2)
            self._agreed = kept * self._agreed + (attempt.motions * motion).sum(axis=2)
            self._moved = kept * self._moved + (motion**2).sum(axis=1)
            self._count = kept * self._count + 1.0


def shortened(motion: FloatArray, most: FloatArray) -> FloatArray:  # [2, 3], [2] -> [2, 3]
    lengths = np.linalg.norm(motion, axis=1)
    shorter: FloatArray = motion * np.minimum(1.0, most / np.maximum(lengths, _TINY))[:, None]
    return shorter


def _powers(x: FloatArray) -> FloatArray:  # [...] -> [..., 4]
    return np.stack([np.ones_like(x), x, x * x, x * x * x], axis=-1)
