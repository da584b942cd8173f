"""What a probe sees at present, while its real frames come late: the scene's frame, corrected by the last real one.

For the newest real frame L, S is the scene's frame at its pose, and R the scene's frame at the present pose. What is
shown is

    g·R + o + Σ_b α_b(d) · T(E_b),    E = L − (g·S + o) = E_fine + E_coarse

Gain g and offset o map the scene's grey values to those of the real frames (least squares over the last of them). E is
what the scene misses: T takes it along with the motion of the probe within the image plane, and the distance d that
the image has moved out of that plane tells how much of it still holds. By which shares α is not assumed: each real
frame shows what the ones before it would have foretold of it, E′ in place of E at the distance d,

    α_b(d) = Σ E_b·E′_b / Σ E_b·E_b, from 0 to 1

A probe that rests thus shows its real frames, one that moves away the scene. Where the late frame as it is came nearer
to the frames that followed, by what the image had moved, it is shown as it is. Free of torch.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, TypeAlias, cast

import cv2
import numpy as np
import numpy.typing as npt

from ultragray.contract import described
from ultragray.geometry.probe import FloatArray, Probe

Grey: TypeAlias = npt.NDArray[np.float32]  # [H, W] in [0, 1]

AGREES = 0.3  # agreement from which on a real frame is taken to be of the scene
_BEFORE = (1, 2, 4, 8)  # real frames ago, which are held against a new one
_FIRST_KNOT_MM, _KNOTS = 0.05, 10  # distances, an octave apart, at which shares and errors are kept
_MEMORY = 0.05  # share of what is known at a distance that a frame at that distance replaces
_GAIN_MEMORY = 0.1  # likewise, of gain and offset
_GAINS = (0.25, 4.0)
_LEAST_SPREAD = 1e-4  # of grey values, square: where frames vary less, the gain is 1
_FINE = 2.0  # pixels: standard deviation of the Gaussian below which details are fine
_HELD_MM = 1.0  # after which 1/e of a detail is taken to hold, where no frame has told yet
_DOUBT = 1.0  # frames that this counts as
_STRUCTURE = (2.0, 6.0)  # pixels: details between these are compared
_LEAST_STRENGTH = 0.02  # of such details, grey values: less is noise
_TINY = 1e-12


@dataclass(frozen=True)
class Preview:
    """What a frame of a stream that gets real frames shows, and how far to trust it."""

    real_age_ms: float = described("From the newest real frame to the time of this one.")
    moved_mm: float = described("By the image since then, root mean square.")
    is_real: bool = described("It is the late real frame itself: that came nearer to the truth than what is rendered.")
    expected_error: float | None = described(
        "Root mean square of grey values from 0 to 1, as of the last real frames when they came; null: too few have."
    )
    agreement: float = described("Correlation of the structures of the newest real frame and the scene's, -1 to 1.")
    trust: float | None = described("Confidence times agreement, 0 to 1; null: the scene knows no confidence.")
    offset_mm: float = described("By which the scene was moved to where the real frames show it.")
    offset_deg: float = described("Likewise.")
    disagrees: bool = described("The newest real frame is not of the scene there, also after a search about its pose.")


class Shown(NamedTuple):
    """What an operator is shown, and what is known of it."""

    frame: Grey
    moved_mm: float
    is_real: bool
    expected_error: float | None


class _Pair(NamedTuple):
    real: Grey
    rendered: Grey
    pose: FloatArray  # [4, 4] mm


class Previewer:
    """Pairs of real and rendered frames [H, W] of one size in, previews out."""

    def __init__(self, probe: Probe) -> None:
        self._probe = probe
        self._pairs: deque[_Pair] = deque(maxlen=max(_BEFORE))  # the newest is the last
        self._moments = np.zeros(5)  # means of the real frames: 1, S, L, S·S, S·L
        # By distance: how much is known, Σ E·E and Σ E·E′ of fine and coarse details, and what was missed by the
        # preview and by the late frame.
        self._known = np.zeros(_KNOTS)
        self._squares, self._products = np.zeros((2, 2, _KNOTS))
        self._missed, self._missed_late = np.zeros((2, _KNOTS))

    def observe(self, real: Grey, rendered: Grey, pose: FloatArray) -> None:
        """Takes a real frame and the scene's at its pose [4, 4], mm."""
        new = _Pair(real, rendered, pose)
        if self._pairs and self._pairs[0].real.shape != real.shape:
            self._pairs.clear()
        for ago in _BEFORE:
            if ago <= len(self._pairs):
                self._learn(self._pairs[-ago], new)
        moments = [1.0, rendered.mean(), real.mean(), np.mean(rendered * rendered), np.mean(rendered * real)]
        self._moments += _GAIN_MEMORY * (np.array(moments, float) - self._moments)
        self._pairs.append(new)

    def show(self, rendered: Grey, pose: FloatArray) -> Shown:
        """The preview at a pose [4, 4], mm, of which the scene shows that. A real frame must have come."""
        newest = self._pairs[-1]
        motion = _Motion.between(self._probe, newest, pose)
        weights = _knot_weights(motion.all_mm)
        if not weights @ self._known and self._known.any():  # the nearest distance that is known tells for it
            (known_at,) = self._known.nonzero()
            weights = np.eye(_KNOTS)[known_at[np.abs(known_at - weights.argmax()).argmin()]]
        known, missed, missed_late = (float(weights @ one) for one in (self._known, self._missed, self._missed_late))
        is_real = missed_late < missed
        frame = newest.real if is_real else self._foretold(newest, rendered, motion)
        error = float(np.sqrt(min(missed, missed_late) / known)) if known > 0.0 else None
        return Shown(frame, motion.all_mm, is_real, error)

    def _learn(self, before: _Pair, new: _Pair) -> None:
        """Holds what a real frame would have foretold of a later one against that."""
        motion = _Motion.between(self._probe, before, new.pose)
        kept = _bands(motion.carried(self._left(before)))
        came = _bands(self._left(new))
        prediction = self._foretold(before, new.rendered, motion)
        rates = _MEMORY * _knot_weights(motion.out_mm)
        self._squares += rates * (np.mean(kept * kept, axis=(1, 2))[:, None] - self._squares)
        self._products += rates * (np.mean(kept * came, axis=(1, 2))[:, None] - self._products)
        rates = _MEMORY * _knot_weights(motion.all_mm)
        self._known += rates * (1.0 - self._known)
        self._missed += rates * (float(np.mean((prediction - new.real) ** 2)) - self._missed)
        self._missed_late += rates * (float(np.mean((before.real - new.real) ** 2)) - self._missed_late)

    def _foretold(self, late: _Pair, rendered: Grey, motion: _Motion) -> Grey:
        kept = _bands(motion.carried(self._left(late)))
        weights = _knot_weights(motion.out_mm)
        assumed = _DOUBT * _MEMORY * np.mean(kept * kept, axis=(1, 2))
        shares = (self._products @ weights + assumed * np.exp(-motion.out_mm / _HELD_MM)) / (
            self._squares @ weights + assumed + _TINY
        )
        prediction = self._mapped(rendered) + np.tensordot(np.clip(shares, 0.0, 1.0).astype(np.float32), kept, 1)
        return cast(Grey, np.clip(prediction, 0.0, 1.0))

    def _left(self, pair: _Pair) -> Grey:
        """What the scene misses of a real frame."""
        return pair.real - self._mapped(pair.rendered)

    def _mapped(self, rendered: Grey) -> Grey:
        """The scene's grey values as the real frames have them: as they are, before any has come."""
        count, mean, real_mean, square, product = self._moments
        if count == 0.0:
            return rendered
        mean, real_mean = mean / count, real_mean / count
        gain = (product / count - mean * real_mean + _LEAST_SPREAD) / (square / count - mean * mean + _LEAST_SPREAD)
        gain = np.clip(gain, *_GAINS)
        mapped: Grey = np.float32(gain) * rendered + np.float32(real_mean - gain * mean)
        return mapped


class _Motion(NamedTuple):
    """The way of an image from one pose to another."""

    out_mm: float  # out of its plane, root mean square over the image
    all_mm: float
    columns: Grey  # in the earlier frame, of each pixel of the later one
    rows: Grey

    @classmethod
    def between(cls, probe: Probe, before: _Pair, pose: FloatArray) -> _Motion:  # [4, 4] mm
        step = np.linalg.solve(before.pose, pose)
        height, width = before.real.shape
        points = _pixels_mm(probe, height, width)
        moved = points @ step[:3, :3].T + step[:3, 3]
        depth, across = probe.lines.coordinates(moved[..., 0], moved[..., 2])
        rows = (depth - probe.near_mm) / probe.scan_line_length_mm * height - 0.5
        columns = (across - probe.lines.start) / probe.lines.span * width - 0.5
        out_mm = float(np.sqrt(np.mean(moved[..., 1] ** 2)))
        all_mm = float(np.sqrt(np.mean(((moved - points) ** 2).sum(axis=-1))))
        return cls(out_mm, all_mm, columns.astype(np.float32), rows.astype(np.float32))

    def carried(self, frame: Grey) -> Grey:
        """The pixels where they lie after the motion within the plane; 0 where something new comes in."""
        return cast(Grey, cv2.remap(frame, self.columns, self.rows, cv2.INTER_LINEAR))


@lru_cache(maxsize=4)
def _pixels_mm(probe: Probe, height: int, width: int) -> FloatArray:  # [H, W, 3]
    rows, columns = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    return probe.points_mm(rows, columns)


def _bands(frame: Grey) -> Grey:  # [H, W] -> [2, H, W], fine and coarse
    coarse = _blurred(frame, _FINE)
    return np.stack([frame - coarse, coarse])


def _blurred(frame: Grey, sigma: float) -> Grey:
    return cast(Grey, cv2.GaussianBlur(frame, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE))


def _knot_weights(distance_mm: float) -> FloatArray:  # [K], sum 1
    place = np.clip(np.log2(max(distance_mm, _TINY) / _FIRST_KNOT_MM), 0.0, _KNOTS - 1.0)
    weights: FloatArray = np.maximum(0.0, 1.0 - np.abs(np.arange(_KNOTS) - place))
    return weights


def agreement(real: Grey, rendered: Grey) -> float:
    """The correlation of what two frames show, whatever gain and shadow made of its brightness: -1 to 1."""
    one, other = (_structures(frame) for frame in (real, rendered))
    one, other = one - one.mean(), other - other.mean()
    return float((one * other).sum() / max(float(np.linalg.norm(one) * np.linalg.norm(other)), _TINY))


def _structures(frame: Grey) -> Grey:
    smooth = _blurred(frame, _STRUCTURE[0])
    structures = smooth - _blurred(smooth, _STRUCTURE[1])
    return cast(Grey, structures / np.sqrt(_blurred(structures * structures, _STRUCTURE[1]) + _LEAST_STRENGTH**2))
