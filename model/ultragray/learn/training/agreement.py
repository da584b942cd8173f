"""The path of a sweep that its neighbouring frames agree with. Read after `alignment`; `poses` calls it.

A tracker errs from frame to frame, and tissue goes along with the probe that presses and drags it. Both make an image
move less from one frame to the next, within its plane, than the poses say. Which path is right the images tell: each
frame is predicted from the two beside it in its sweep, in space, and of these paths the one is taken that predicts best:

- as tracked;
- without the tracker's noise (`alignment.without_noise`);
- that, but of the motion within the image plane only a share: of the shifts along the lateral and the axial axis, and
  of the turn about the elevation axis. 1: tissue is rigid; 0: it stays where it is in the image, and the frames are a
  straight stack along their path.

Another path than the tracked one has to predict better, by LEAST_GAIN_DB or GAIN_OF_SHARES_DB. Of motion across the
plane the images of one sweep say little: there the smoothness of the path is the only evidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from ultragray.geometry.probe import FloatArray, Probe
from ultragray.geometry.registration import register_points
from ultragray.geometry.rotations import blended, rotations_of, turns_of
from ultragray.geometry.scan_conversion import interpolated_frames, pixel_places
from ultragray.learn.sweep import Dataset, IntArray, Sweep, corner_distances_mm, spread_places
from ultragray.learn.training.alignment import TrackerNoise, sweep_ranges, tracker_noise, without_noise

FRAMES, PIXELS = 96, 4096  # that are predicted, of each: enough to tell one path from another
ON_PLANE_MM = 1e-6  # distances are at least that: the nearer frame then has all the weight
LEAST_GAIN_DB = 0.05  # of a path without noise
GAIN_OF_SHARES_DB = 0.3  # tissue is rigid unless the images say clearly that it is not
SHARE_STEP = 0.25

Shares: TypeAlias = tuple[float, float, float]  # of the motion within the plane: lateral, axial, turn
RIGID: Shares = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Agreement:
    """How well frames are predicted by the two beside them, mean PSNR in dB."""

    in_time_db: float  # pixel by pixel, whatever the poses say
    tracked_db: float  # in space, as tracked
    found_db: float  # in space, on the path that was found
    shares: Shares  # of the motion within the plane that it has
    noise: TrackerNoise  # of the tracker


def on_agreed_path(dataset: Dataset) -> Dataset:
    """The same with the poses of `agreed_path`; the dataset itself where these are as tracked."""
    path = agreed_path(dataset)
    if path.train is dataset.train.poses:
        return dataset
    return replace(dataset, train=replace(dataset.train, poses=path.train), val=replace(dataset.val, poses=path.val))


@dataclass(frozen=True, eq=False)
class AgreedPath:
    """Poses of the training and the held-out frames (mm); as tracked where no other path agrees better."""

    train: FloatArray  # [F, 4, 4]
    val: FloatArray  # [V, 4, 4] of which no image was used
    agreement: Agreement | None  # None: no sweep has three frames in a row


def agreed_path(dataset: Dataset) -> AgreedPath:
    """The path of all frames, judged by the training frames alone.

    Held-out frames of the same recording take part in the path by their poses. Those of another file are moved as the
    training frames about them are.
    """
    train, val = dataset.train, dataset.val
    tracked = AgreedPath(train.poses, val.poses, None)
    if (judge := _Judge.of(train, sweep_ranges(train))) is None:
        return tracked
    is_one = train.source == val.source and not set(train.frame_numbers) & set(val.frame_numbers)
    numbers = np.concatenate([train.frame_numbers, val.frame_numbers if is_one else []])
    order = np.argsort(numbers, kind="stable")
    place = np.argsort(order, kind="stable")  # of each frame on the path
    given = np.concatenate([train.poses, val.poses])[order] if is_one else train.poses
    places = place[: len(train)] if is_one else np.arange(len(train))
    ranges = sweep_ranges(replace(train, images=_one_each(given), poses=given, frame_numbers=np.arange(len(given))))
    best, best_db = given, (tracked_db := judge.psnr_db(train.poses))
    cleaned = without_noise(given, ranges)
    if (db := judge.psnr_db(cleaned[places])) > best_db + LEAST_GAIN_DB:
        best, best_db = cleaned, db
    shares, moved, db = _best_shares(judge, best, ranges, train.probe, places, best_db)
    if db < best_db + GAIN_OF_SHARES_DB:
        shares, moved, db = RIGID, best, best_db
    agreement = Agreement(judge.in_time_db(), tracked_db, db, shares, tracker_noise(given, ranges))
    if moved is given:
        return replace(tracked, agreement=agreement)
    held_out = moved[place[len(train) :]] if is_one else _carried(val.poses, best, moved, ranges, train.probe)
    return AgreedPath(moved[places], held_out, agreement)


def _best_shares(
    judge: _Judge, poses: FloatArray, ranges: Sequence[range], probe: Probe, places: IntArray, rigid_db: float
) -> tuple[Shares, FloatArray, float]:
    """The shares of the best prediction, the path with them, and its PSNR: first alike for all three, then each."""
    tried: dict[Shares, float] = {RIGID: rigid_db}

    def psnr_db(shares: Shares) -> float:
        if shares not in tried:
            tried[shares] = judge.psnr_db(with_shares(poses, ranges, probe, shares)[places])
        return tried[shares]

    common = np.arange(1.0, -SHARE_STEP / 2, -SHARE_STEP).tolist()
    best: Shares = max(((share, share, share) for share in common), key=psnr_db)
    for number in range(3):
        for step in (SHARE_STEP, -SHARE_STEP):
            other = _stepped(best, number, step)
            while psnr_db(other) > psnr_db(best):
                best, other = other, _stepped(other, number, step)
    return best, with_shares(poses, ranges, probe, best), psnr_db(best)


def _stepped(shares: Shares, number: int, step: float) -> Shares:
    changed = [min(max(share + step * (i == number), 0.0), 1.0) for i, share in enumerate(shares)]
    return changed[0], changed[1], changed[2]


def with_shares(poses: FloatArray, ranges: Sequence[range], probe: Probe, shares: Shares) -> FloatArray:
    """The paths [F, 4, 4], mm, with a share of their motion within the image plane; each sweep lies where it lay.

    The motion from one frame to the next is a turn and a shift of the middle of the image along the probe's axes.
    """
    if shares == RIGID:
        return poses
    middle, corners = probe.corners_mm().mean(axis=0), probe.corners_mm()
    lateral, axial, turn = shares
    found = poses.copy()
    for frames in ranges:
        own = poses[frames.start : frames.stop]
        steps = np.linalg.inv(own[:-1]) @ own[1:]
        shifts = steps[:, :3, :3] @ middle + steps[:, :3, 3] - middle
        steps[:, :3, :3] = rotations_of(turns_of(steps[:, :3, :3]) * (1.0, turn, 1.0))
        steps[:, :3, 3] = middle + shifts * (lateral, 1.0, axial) - steps[:, :3, :3] @ middle
        moved = own.copy()
        for place, step in enumerate(steps):
            moved[place + 1] = moved[place] @ step
        of_all = [np.einsum("fij,cj->fci", p[:, :3, :3], corners) + p[:, None, :3, 3] for p in (moved, own)]
        back = register_points(*(points.reshape(-1, 3) for points in of_all)).transform
        found[frames.start : frames.stop] = back @ moved
    return found


def _carried(
    poses: FloatArray,  # [V, 4, 4] mm
    before: FloatArray,  # [F, 4, 4] mm
    after: FloatArray,  # [F, 4, 4] mm
    ranges: Sequence[range],
    probe: Probe,
) -> FloatArray:  # [V, 4, 4] mm
    """Poses moved as the two frames of the nearest sweep are between which they lie, by the distances from them."""
    corners, middle = probe.corners_from(before), np.append(probe.corners_mm().mean(axis=0), 1.0)
    motions = after @ np.linalg.inv(before)
    sweep_of = np.repeat(np.arange(len(ranges)), [len(frames) for frames in ranges])
    found = poses.copy()
    for place, own in enumerate(probe.corners_from(poses)):
        distances = corner_distances_mm(corners, own)
        nearest = int(distances.argmin())
        beside = [i for i in (nearest - 1, nearest + 1) if 0 <= i < len(before) and sweep_of[i] == sweep_of[nearest]]
        other = min(beside, key=distances.__getitem__, default=nearest)
        share = distances[nearest] / max(distances[nearest] + distances[other], 1e-9)
        both = motions[[nearest, other]]
        there = (both @ poses[place] @ middle)[:, :3]
        turn = blended(both[:1, :3, :3], both[1:, :3, :3], np.array([share]))[0]
        found[place, :3, :3] = turn @ poses[place, :3, :3]
        found[place, :3, 3] = (1.0 - share) * there[0] + share * there[1] - found[place, :3, :3] @ middle[:3]
    return found


def _one_each(poses: FloatArray) -> np.ndarray:  # [F, 1, 2] uint8
    """Images that a sweep takes where its path alone counts."""
    return np.tile(np.array([0, 1], np.uint8), (len(poses), 1, 1))


@dataclass(frozen=True, eq=False)
class _Judge:
    """Pixels of frames that are predicted from the two frames beside them in their sweep."""

    sweep: Sweep
    frames: IntArray  # [P] their places
    rows: IntArray  # [P, N] of the pixels
    columns: IntArray  # [P, N]

    @classmethod
    def of(cls, sweep: Sweep, ranges: Sequence[range]) -> _Judge | None:
        frames = np.concatenate([np.arange(some.start + 1, some.stop - 1) for some in ranges])
        if not len(frames):
            return None
        chosen, random = frames[spread_places(len(frames), FRAMES)], np.random.default_rng(0)
        rows, columns = (random.integers(size, size=(len(chosen), PIXELS)) for size in (sweep.height, sweep.width))
        return cls(sweep, chosen, rows, columns)

    def psnr_db(self, poses: FloatArray) -> float:  # [F, 4, 4] mm
        """Of the pixels as predicted in space by these poses.

        A pixel is projected onto both planes along their normals; what these show there counts in inverse proportion to
        the distances. One that is projected beside an image is predicted by the other alone, or left out.
        """
        sweep, probe = self.sweep, self.sweep.probe
        local = probe.points_mm((self.rows + 0.5) / sweep.height, (self.columns + 0.5) / sweep.width)  # [P, N, 3]
        values, weights = [], []
        for beside in (self.frames - 1, self.frames + 1):
            across = np.linalg.inv(poses[beside]) @ poses[self.frames]
            seen = np.einsum("pij,pnj->pni", across[:, :3, :3], local) + across[:, None, :3, 3]
            rows, columns = probe.image_coordinates(seen[..., 0], seen[..., 2])
            is_in = ~np.isnan(rows)
            places = pixel_places(
                probe, sweep.images.shape[1:], *(np.where(is_in, one, 0.0) for one in (rows, columns))
            )
            values.append(interpolated_frames(sweep.images, beside[:, None], *places))
            weights.append(is_in / np.maximum(np.abs(seen[..., 1]), ON_PLANE_MM))
        total = sum(weights)
        predicted = (values[0] * weights[0] + values[1] * weights[1]) / np.maximum(total, 1e-9)
        return self._mean_psnr_db(predicted, total > 0.0)

    def in_time_db(self) -> float:
        """Of the pixels as the mean of the same pixels of the two frames."""
        before, after = (self._shown(beside) for beside in (self.frames - 1, self.frames + 1))
        return self._mean_psnr_db((before + after) / 2.0, np.ones(self.rows.shape, bool))

    def _shown(self, frames: IntArray) -> FloatArray:  # [P] -> [P, N]
        return self.sweep.images[frames[:, None], self.rows, self.columns].astype(np.float64)

    def _mean_psnr_db(self, predicted: FloatArray, is_known: npt.NDArray[np.bool_]) -> float:  # [P, N] both
        squared = np.square(predicted - self._shown(self.frames)) * is_known
        errors = squared.sum(axis=1) / np.maximum(is_known.sum(axis=1), 1) / 255.0**2
        return float(np.mean(-10.0 * np.log10(np.maximum(errors, 1e-10))))
