"""The sweep of a hand, in silico: the phantom under a probe that a hand moves, and what goes wrong with its poses.

The hand goes 0.7 mm from one frame to the next, wanders and trembles. Frames are those of the phantom at the true
poses. What is given is not the truth: the tracker errs from frame to frame (`noise`) and slowly (`wander`), its poses
come too late (`delay`), the image lies otherwise under the tracked body than the calibration says (`calibration`), and
the tissue goes along with the probe that drags and presses it (`tissue`), most near its face.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from ultragray.geometry.probe import FloatArray, LinearProbe
from ultragray.geometry.rotations import rotations_of, transforms_of
from ultragray.learn.sweep import ByteArray, Dataset, IntArray, Sweep
from ultragray.phantom import simulate

PROBE, HEIGHT, WIDTH = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=45.0), 192, 144
SPACING_MM, FRAME_S = 0.7, 0.05
TICK_S = 0.005  # of the hand's motion
MARGIN_S = 1.0  # of it, before the first frame and after the last
TISSUE_DEPTH_MM = 40.0  # at which tissue follows the probe by 1/e
TISSUE_S = 3.0  # a hand's motion that is slower than that moves over the tissue

# A hand's motion about its way: standard deviations along and about x, y, z of the probe (mm, degrees), and seconds
SWAYS = (((2.0, 0.0, 0.8), (1.5, 1.0, 1.0), 1.25), ((0.25, 0.2, 0.2), (0.2, 0.2, 0.15), 0.15))


@dataclass(frozen=True)
class Errors:
    """What is wrong with the poses and the images of a sweep; nothing, unless given."""

    noise_mm: float = 0.0  # standard deviation along each axis, new in every frame
    noise_deg: float = 0.0
    wander_mm: float = 0.0  # the same of an error that changes over a second
    wander_deg: float = 0.0
    delay_ms: float = 0.0  # images are stamped so much later than their poses
    calibration_mm: float = 0.0  # length of the shift, in a direction that leads along all axes
    calibration_deg: float = 0.0
    tissue: float = 0.0  # share of the hand's swaying that tissue at the face follows


class Hand:
    """The motion of a hand in one pass: its way, and what it sways about it."""

    def __init__(self, random: np.random.Generator, count: int, angle_deg: float) -> None:
        """`angle_deg` is the direction of the pass, and of the probe, about the normal of the skin."""
        self.seconds = np.arange(-MARGIN_S, count * FRAME_S + MARGIN_S, TICK_S)
        sways = np.zeros((len(self.seconds), 6))
        for shifts, turns, over_s in SWAYS:
            sways += _smooth_noise(random, len(sways), over_s) * (*shifts, *turns)
        self._along_mm = (self.seconds / FRAME_S - (count - 1) / 2.0) * SPACING_MM
        self._sways, self._axes = sways, rotations_of(np.radians([[0.0, 0.0, angle_deg]]))[0]

    def poses(self, times_s: FloatArray) -> FloatArray:  # [F] -> [F, 4, 4] mm
        sways, along_mm = self.at(self._sways, times_s), self.at(self._along_mm[:, None], times_s)[:, 0]
        shifts = (sways[:, :3] + along_mm[:, None] * (0.0, 1.0, 0.0)) @ self._axes.T
        return transforms_of(self._axes @ rotations_of(np.radians(sways[:, 3:])), shifts)

    def dragging_mm(self, times_s: FloatArray) -> FloatArray:  # [F] -> [F, 3]
        """The sways along the axes of the probe that drag the tissue, which slips back under slower ones."""
        return self.at(self._sways[:, :3] - _smoothed(self._sways[:, :3], TISSUE_S), times_s)

    def at(self, values: FloatArray, times_s: FloatArray) -> FloatArray:  # [T, K], [F] -> [F, K]
        """What changes with the hand's `seconds`, at other times."""
        return np.stack([np.interp(times_s, self.seconds, column) for column in values.T], axis=1)


def _smooth_noise(random: np.random.Generator, count: int, over_s: float) -> FloatArray:  # [T, 6], deviation 1
    noise = _smoothed(random.normal(size=(count, 6)), over_s)
    noise /= noise.std(axis=0)
    return noise


def _smoothed(values: FloatArray, over_s: float) -> FloatArray:  # [T, K] both
    kernel = np.exp(-0.5 * np.square(np.arange(-3.0 * over_s, 3.0 * over_s + TICK_S, TICK_S) / over_s))
    half = len(kernel) // 2
    padded = np.pad(values, ((half, len(kernel) - 1 - half), (0, 0)), mode="reflect")
    return np.stack([np.convolve(one, kernel / kernel.sum(), "valid") for one in padded.T], axis=1)


@dataclass(frozen=True, eq=False)
class HandSweep:
    """Passes of a hand over the phantom, as they were in truth."""

    hands: tuple[Hand, ...]
    count: int  # of frames of each pass
    poses: FloatArray  # [F, 4, 4] mm
    images: ByteArray  # [F, H, W] of tissue that stays where it is

    @classmethod
    @lru_cache(maxsize=4)
    def of(cls, angles_deg: tuple[float, ...], count: int, seed: int = 0) -> HandSweep:
        """A pass of `count` frames in each of these directions; about a second for each frame."""
        random = np.random.default_rng(seed)
        hands = tuple(Hand(random, count, angle) for angle in angles_deg)
        poses = np.concatenate([hand.poses(_times_s(count)) for hand in hands])
        return cls(hands, count, poses, simulate(poses, probe=PROBE, height=HEIGHT, width=WIDTH))

    def recorded(self, errors: Errors, seed: int = 1) -> Dataset:
        """As a tracker records it, with these errors: every second frame held out."""
        images = self.images
        if errors.tissue:
            sways = np.concatenate([hand.dragging_mm(_times_s(self.count)) for hand in self.hands])
            images = np.stack([_dragged(*pair) for pair in zip(images, errors.tissue * sways, strict=True)])
        return self._dataset(images, self._tracked(errors, np.random.default_rng(seed)))

    def _tracked(self, errors: Errors, random: np.random.Generator) -> FloatArray:  # [F, 4, 4] mm
        times_s = _times_s(self.count) + errors.delay_ms / 1000.0
        passes = []
        for hand in self.hands:
            wander = hand.at(_smooth_noise(random, len(hand.seconds), 1.0), times_s)
            noise = random.normal(size=(self.count, 6))
            sizes = [(errors.noise_mm, errors.noise_deg), (errors.wander_mm, errors.wander_deg)]
            offsets = sum(part * ([mm] * 3 + [deg] * 3) for part, (mm, deg) in zip((noise, wander), sizes, strict=True))
            passes.append(_moved(hand.poses(times_s), np.asarray(offsets)))
        off = np.array([1.0, -1.0, 1.0]) / np.sqrt(3.0)
        calibration = np.concatenate([errors.calibration_mm * off, errors.calibration_deg * off[[1, 0, 2]]])
        return _moved(np.concatenate(passes), calibration[None])

    def _dataset(self, images: ByteArray, poses: FloatArray) -> Dataset:
        places = np.arange(len(poses))
        times_s = np.concatenate([_times_s(self.count) + number * 60.0 for number in range(len(self.hands))])
        sweep = Sweep(images, poses, PROBE, places, "the sweep of a hand", times_s=times_s)
        held_out = held_out_places(self.count, len(self.hands))
        return Dataset("hand", sweep.select(np.setdiff1d(places, held_out)), sweep.select(held_out))


def held_out_places(count: int, passes: int) -> IntArray:
    """Every second frame of each pass, but those at its ends."""
    return np.concatenate([np.arange(1, count - 1, 2) + number * count for number in range(passes)])


def _times_s(count: int) -> FloatArray:  # [F]
    return FRAME_S * np.arange(count, dtype=np.float64)


def _moved(poses: FloatArray, by: FloatArray) -> FloatArray:  # [F, 4, 4] mm, [F or 1, 6] mm, degrees
    """The poses, moved in the frame of the probe."""
    moved: FloatArray = poses @ transforms_of(rotations_of(np.radians(by[:, 3:])), by[:, :3])
    return moved


def _dragged(image: ByteArray, sway_mm: FloatArray) -> ByteArray:  # [H, W], [3] along the probe's axes
    """The image of tissue that has gone along with the probe by so much at its face, and less with depth."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    depths_mm = (rows + 0.5) * PROBE.scan_line_length_mm / HEIGHT
    share = np.exp(-depths_mm / TISSUE_DEPTH_MM)
    lateral, axial = (share * sway_mm[axis] for axis in (0, 2))
    columns -= (lateral * WIDTH / PROBE.width_mm).astype(np.float32)
    rows -= (axial * HEIGHT / PROBE.scan_line_length_mm).astype(np.float32)
    dragged = cv2.remap(image, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return dragged.astype(np.uint8, copy=False)
