"""The path of a sweep that its neighbouring frames agree with. Read after `alignment`; `poses` calls it.

A tracker errs from frame to frame, and tissue goes along with the probe that presses and drags it. Both make an image
move less from one frame to the next, within its plane, than the poses say. Which path is right the images tell: each
frame is predicted from two about it in its sweep, in space, and of these paths that one is taken that predicts best:

- as tracked;
- without the tracker's noise (`alignment.without_noise`);
- that, a delay of the images earlier (`delay`), where their times are known, if all that follows predicts better so;
- that, with another calibration from the image to the probe, where sweeps cross (`alignment.found_calibration`);
- that, but of the motion within the image plane only a share: of the shifts along the lateral and the axial axis, and
  of the turn about the elevation axis. 1: tissue is rigid; 0: it stays where it is in the image, and the frames are a
  straight stack along their path;
- that, evened out across the image plane: where images have no exact times, or a tracker repeats its poses, the probe
  seems to hasten and to halt from one frame to the next, which is no white noise;
- that, with a smooth motion of each pass by which passes agree where they cross (`crossing`).

Another path than the tracked one has to predict better, by LEAST_GAIN_DB, GAIN_OF_DELAY_DB, GAIN_OF_SHARES_DB or
GAIN_OF_EVENNESS_DB; the last of them, which other passes speak for, may predict neighbours worse by
LOSS_OF_CROSSING_DB. Of motion across the plane the images of one sweep say little: there the smoothness of the path is
most of the evidence.
Free of torch, since data sets are checked without it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np

from ultragray.geometry.probe import FloatArray, Probe
from ultragray.geometry.rotations import blended, mean_axes, rotations_of, transforms_of, turns_of
from ultragray.geometry.scan_conversion import interpolated_sharply
from ultragray.learn.marks import burnt_in
from ultragray.learn.prediction import blend_by_distance, blend_in_time, frame_times, seen_by_frame
from ultragray.learn.sweep import Dataset, IntArray, Sweep, corner_distances_mm, spread_places
from ultragray.learn.training.alignment import (
    TrackerNoise,
    found_calibration,
    path_ranges,
    sweep_ranges,
    tracker_noise,
    without_noise,
)
from ultragray.learn.training.crossing import Agreement, crossing_agreement
from ultragray.learn.training.delay import found_delay_s, with_delay

FRAMES, PIXELS = 96, 2048  # that are predicted, of each: enough to tell one path from another
LEAST_GAIN_DB = 0.05  # of a path without noise
GAIN_OF_DELAY_DB = 0.03  # at the end of the path: shares and calibration may have explained it better
LEAST_DELAYED = 16  # frames that are predicted: of fewer, a real hand told any delay from -400 to 130 ms
EVEN_FRAMES = 4.0  # standard deviation of the Gaussian that evens out the steps from frame to frame
GAIN_OF_EVENNESS_DB = 0.03  # where poses are exact, it loses
LOSS_OF_CROSSING_DB = 0.1  # within the passes, for their agreement
GAIN_OF_SHARES_DB = 0.3  # tissue is rigid unless the images say clearly that it is not
NEAR_GAIN_DB = 0.1  # of these on the neighbours alone: it was .17 and more where tissue moved, .08 in a rigid phantom
SHARE_STEP = 0.25
FEW = 1 / 3  # of the frames, those that gain most by shares
LOSS_OF_OTHERS_DB = 0.2  # by shares, on the mean of the other frames
FAR = 4  # frames away from the one that is predicted
LEAST_PREDICTED = 8  # frames: fewer may fit any shares, and an even path, by chance
CROSSING_FRAMES, CROSSING_PIXELS = 48, 512  # that are looked at in other passes, of each
CROSSING_MM = 1.0  # of a pixel from a frame of another pass: it shows the same
MARK_MARGIN = 5  # pixels, odd: what is burnt in shines upon those beside it
LEAST_CROSSING = 1000  # pixels that other passes show: fewer say little

Shares: TypeAlias = tuple[float, float, float]  # of the motion within the plane: lateral, axial, turn
RIGID: Shares = (1.0, 1.0, 1.0)
_ACROSS = (1, 3, 5)  # of a step: shift along the elevation axis, turns about the lateral and the axial one


@dataclass(frozen=True, eq=False)
class AgreedPath:
    """Poses of the training and the held-out frames in the tissue at rest, mm, and how well training frames are
    predicted by the two beside them, mean PSNR in dB."""

    train: FloatArray  # [F, 4, 4]
    val: FloatArray  # [V, 4, 4] of which no image was used
    tracked: FloatArray  # [F, 4, 4] of the training frames in the tracker's frame, without its noise and the delay
    in_time_db: float  # pixel by pixel, whatever the poses say
    tracked_db: float  # in space, as tracked
    noise: TrackerNoise  # of the tracker
    is_smoothed: bool  # the noise was taken off
    delay_s: float  # of the images behind their poses, which is taken off
    found_db: float  # in space, on this path
    calibration: FloatArray  # [4, 4] right-multiplied to the poses, mm: the identity where none is better
    shares: Shares  # of the motion within the plane that it has
    is_evened: bool  # across the plane
    crossing: Agreement | None  # of its passes; None where they agree as they are, or do not cross

    def of(self, dataset: Dataset) -> Dataset:
        """The same frames on this path; the dataset itself where that is as tracked."""
        if self.train is dataset.train.poses:
            return dataset
        train, val = replace(dataset.train, poses=self.train), replace(dataset.val, poses=self.val)
        return replace(dataset, train=train, val=val)


def agreed_path(dataset: Dataset) -> AgreedPath | None:
    """The path of all frames, judged by the training frames alone; None where no sweep has three frames in a row.

    Poses are those of the dataset where no other path agrees better. Held-out frames of the same recording
    (`Dataset.places`) take part in the path by their poses. Others are moved as the training frames about them are.
    """
    train, val = dataset.train, dataset.val
    if (judge := _Judge.of(train, sweep_ranges(train))) is None:
        return None
    known = dataset.places
    whole = [train] if known is None else [train, val]
    places = np.argsort(np.argsort(train.frame_numbers)) if known is None else known  # of each frame on the path
    order = np.argsort(places)
    on_path = places[: len(train)]
    tracker_poses = np.concatenate([part.poses for part in whole])[order]
    ranges = path_ranges(train.probe.corners_from(tracker_poses))
    tracked_db, cleaned = judge.psnr_db(train.poses), without_noise(tracker_poses, ranges)
    is_smoothed = judge.psnr_db(cleaned[on_path]) > tracked_db + LEAST_GAIN_DB
    tracked = cleaned if is_smoothed else tracker_poses  # in the tracker's frame, by the calibration that was given
    best, delay_s = _Path.of(judge, tracked, ranges, on_path), 0.0
    times_s = _times_of(whole)
    if times_s is not None and len(judge.frames) >= LEAST_DELAYED:
        ordered_s = times_s[order]
        earlier = partial(with_delay, tracked, ordered_s, ranges)
        likely_s = found_delay_s(lambda one_s: judge.psnr_db(earlier(one_s)[on_path]), ordered_s, ranges)
        if likely_s:
            other = _Path.of(judge, earlier(likely_s), ranges, on_path)
            if other.predicted_db >= best.predicted_db + GAIN_OF_DELAY_DB:
                tracked, best, delay_s = earlier(likely_s), other, likely_s
    noise = tracker_noise(tracker_poses, ranges)
    figures = judge.in_time_db(), tracked_db, noise, is_smoothed, delay_s, *best[1:]
    if best.poses is tracker_poses:
        return AgreedPath(train.poses, val.poses, train.poses, *figures)
    if known is not None:
        return AgreedPath(best.poses[on_path], best.poses[places[len(train) :]], tracked[on_path], *figures)
    held_out = val.poses
    if delay_s and val.times_s is not None:
        held_out = with_delay(held_out, val.times_s, sweep_ranges(val), delay_s)
    carried = _carried(held_out, tracked, best.poses, ranges, train.probe)
    return AgreedPath(best.poses[on_path], carried, tracked[on_path], *figures)


class _Path(NamedTuple):
    """A path by all that follows the delay."""

    poses: FloatArray  # [F, 4, 4] mm
    predicted_db: float
    calibration: FloatArray  # [4, 4] mm
    shares: Shares
    is_evened: bool
    crossing: Agreement | None

    @classmethod
    def of(cls, judge: _Judge, tracked: FloatArray, ranges: Sequence[range], places: IntArray) -> _Path:
        """From the poses [F, 4, 4] (mm) of a tracker without its noise; training frames have these places on them."""
        train = judge.sweep
        path, path_db = tracked, judge.psnr_db(tracked[places])
        calibration = found_calibration(replace(train, poses=path[places]), sweep_ranges(train))
        if not np.array_equal(calibration, np.eye(4)):
            if (db := judge.psnr_db((path @ calibration)[places])) >= path_db - LEAST_GAIN_DB:
                path, path_db = path @ calibration, db
            else:
                calibration = np.eye(4)  # what makes neighbouring frames predict each other worse is none
        shares = _best_shares(judge, path, ranges, places)
        if shares != RIGID:
            path = with_shares(path, ranges, train.probe, shares)
            path_db = judge.psnr_db(path[places])
        even = evened(path, ranges, train.probe)
        db, is_known = judge.psnr_db(even[places]), len(judge.frames) >= LEAST_PREDICTED
        if is_evened := is_known and db > path_db + GAIN_OF_EVENNESS_DB:
            path, path_db = even, db
        if (crossing := crossing_agreement(train, path, ranges, places)) is not None:
            if (db := judge.psnr_db((path @ crossing.motions)[places])) >= path_db - LOSS_OF_CROSSING_DB:
                path, path_db = path @ crossing.motions, db
            else:
                crossing = None
        return cls(path, path_db, calibration, shares, is_evened, crossing)


def _times_of(parts: Sequence[Sweep]) -> FloatArray | None:  # [F] s
    """Of all frames; None where some have none."""
    times = [part.times_s for part in parts if part.times_s is not None]
    return np.concatenate(times) if len(times) == len(parts) else None


def _best_shares(judge: _Judge, poses: FloatArray, ranges: Sequence[range], places: IntArray) -> Shares:
    """The shares that predict frames best, first alike for all three, then each; RIGID where they gain little, or where
    few frames can be predicted, and where passes that cross contradict them.

    Within one pass a probe that glides over layers looks as if they followed it. Two passes tell: tissue that follows
    is shown alike by both once it is at rest, and rigid tissue is not.

    Frames are predicted from their neighbours and from those FAR away. A slow hand hardly moves within the plane from
    one frame to the next: then far ones tell. They show less of the same anatomy, and alone they would err: neighbours
    have to gain, too.

    A probe that is lifted off shows the same air wherever it goes, as if that followed it: such frames gain more than
    all others lose.
    """

    def path(shares: Shares) -> FloatArray:
        return with_shares(poses, ranges, judge.sweep.probe, shares)[places]

    @cache
    def psnr_db(shares: Shares) -> float:
        return (judge.psnr_db(path(shares)) + judge.psnr_db(path(shares), FAR)) / 2.0

    if len(judge.frames) < LEAST_PREDICTED:
        return RIGID
    common = np.arange(1.0, -SHARE_STEP / 2, -SHARE_STEP).tolist()
    best: Shares = max(((share, share, share) for share in common), key=psnr_db)
    for number in range(3):
        for step in (SHARE_STEP, -SHARE_STEP):
            other = _stepped(best, number, step)
            while psnr_db(other) > psnr_db(best):
                best, other = other, _stepped(other, number, step)
    if psnr_db(best) < psnr_db(RIGID) + GAIN_OF_SHARES_DB:
        return RIGID
    near, far = (judge.frames_db(path(best), reach) - judge.frames_db(path(RIGID), reach) for reach in (1, FAR))
    gains = np.concatenate([near, far])
    others_db = np.sort(gains)[: round((1.0 - FEW) * len(gains))].mean()
    if near.mean() < NEAR_GAIN_DB or others_db < -LOSS_OF_OTHERS_DB:
        return RIGID
    still, moved = (judge.crossing_db(path(one)) for one in (RIGID, best))
    return RIGID if still is not None and (moved is None or moved < still - LEAST_GAIN_DB) else best


def _stepped(shares: Shares, number: int, step: float) -> Shares:
    changed = [min(max(share + step * (i == number), 0.0), 1.0) for i, share in enumerate(shares)]
    return changed[0], changed[1], changed[2]


def with_shares(poses: FloatArray, ranges: Sequence[range], probe: Probe, shares: Shares) -> FloatArray:
    """The paths [F, 4, 4], mm, with a share of their motion within the image plane."""
    if shares == RIGID:
        return poses
    lateral, axial, turn = shares
    return _with_steps(poses, ranges, probe, lambda steps: steps * (lateral, 1.0, axial, 1.0, turn, 1.0))


def evened(poses: FloatArray, ranges: Sequence[range], probe: Probe) -> FloatArray:
    """The paths [F, 4, 4], mm, with steps across the image plane that change slowly from frame to frame."""
    reach = round(4.0 * EVEN_FRAMES)
    weights = np.exp(-0.5 * np.square(np.arange(-reach, reach + 1) / EVEN_FRAMES))

    def slow(steps: FloatArray) -> FloatArray:  # [N, 6] -> [N, 6]
        smooth = steps.copy()
        for number in _ACROSS:
            longer = np.pad(steps[:, number], reach, mode="edge")
            smooth[:, number] = np.convolve(longer, weights / weights.sum(), mode="valid")
        return smooth

    return _with_steps(poses, ranges, probe, slow)


def _with_steps(
    poses: FloatArray, ranges: Sequence[range], probe: Probe, changed: Callable[[FloatArray], FloatArray]
) -> FloatArray:  # [F, 4, 4] mm -> [F, 4, 4] mm
    """The paths with other steps from one frame to the next.

    A step [6] is a shift of the middle of the image, mm, and a turn about it, rad, along the axes of the probe. The
    middle of all images and their mean orientation stay for each sweep.
    """
    middle = probe.corners_mm().mean(axis=0)
    paths = poses.copy()
    for frames in ranges:
        own = poses[frames.start : frames.stop]
        if len(own) < 2:
            continue
        motions = np.linalg.inv(own[:-1]) @ own[1:]
        shifts = motions[:, :3, :3] @ middle + motions[:, :3, 3] - middle
        steps = changed(np.concatenate([shifts, turns_of(motions[:, :3, :3])], axis=1))
        motions[:, :3, :3] = rotations_of(steps[:, 3:])
        motions[:, :3, 3] = middle + steps[:, :3] - motions[:, :3, :3] @ middle
        moved = own.copy()
        for place, motion in enumerate(motions):
            moved[place + 1] = moved[place] @ motion
        turn = mean_axes(own @ np.linalg.inv(moved))
        from_middle, to_middle = ((path[:, :3, :3] @ middle + path[:, :3, 3]).mean(axis=0) for path in (moved, own))
        paths[frames.start : frames.stop] = transforms_of(turn, to_middle - turn @ from_middle) @ moved
    return paths


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
    new_poses = poses.copy()
    for place, own in enumerate(probe.corners_from(poses)):
        distances = corner_distances_mm(corners, own)
        nearest = int(distances.argmin())
        beside = [i for i in (nearest - 1, nearest + 1) if 0 <= i < len(before) and sweep_of[i] == sweep_of[nearest]]
        other = min(beside, key=distances.__getitem__, default=nearest)
        share = distances[nearest] / max(distances[nearest] + distances[other], 1e-9)
        both = motions[[nearest, other]]
        there = (both @ poses[place] @ middle)[:, :3]
        turn = blended(both[:1, :3, :3], both[1:, :3, :3], np.array([share]))[0]
        new_poses[place, :3, :3] = turn @ poses[place, :3, :3]
        new_poses[place, :3, 3] = (1.0 - share) * there[0] + share * there[1] - new_poses[place, :3, :3] @ middle[:3]
    return new_poses


@dataclass(frozen=True, eq=False)
class _Judge:
    """Pixels of frames that are predicted from two frames about them in their sweep; mean PSNR of the frames."""

    sweep: Sweep
    frames: IntArray  # [P] their places
    far: IntArray  # [Q] those that have frames FAR before and behind them
    passes: IntArray  # [F] the pass of each frame
    marks: Sweep | None  # one picture, bright about what is burnt into all images; None: nothing is
    _known_points: dict[int, tuple[FloatArray, FloatArray]] = field(default_factory=dict, init=False)

    @classmethod
    def of(cls, sweep: Sweep, ranges: Sequence[range]) -> _Judge | None:
        frames, far = (
            np.concatenate([np.arange(some.start + reach, some.stop - reach) for some in ranges]) for reach in (1, FAR)
        )
        if not len(frames):
            return None
        passes = np.repeat(np.arange(len(ranges)), [len(some) for some in ranges])
        frames, far = (some[spread_places(len(some), FRAMES)] for some in (frames, far))
        return cls(sweep, frames, far, passes, _marks_of(sweep))

    def psnr_db(self, poses: FloatArray, reach: int = 1) -> float:  # [F, 4, 4] mm
        """The mean of `frames_db`."""
        return float(self.frames_db(poses, reach).mean())

    def frames_db(self, poses: FloatArray, reach: int = 1) -> FloatArray:  # [F, 4, 4] mm -> [P or Q]
        """Of the pixels as predicted in space by these poses, from the frames `reach` (1, or FAR where there are such)
        before and behind.

        A pixel is projected onto both planes along their normals; what these show there counts in inverse proportion to
        the distances. One that is projected beside an image is predicted by the other alone, or left out. Between
        pixels, planes are interpolated sharply: blurring would speak for frames that do not move.
        """
        frames, reach = (self.frames, 1) if reach == 1 or not len(self.far) else (self.far, reach)
        inverses = np.asarray(np.linalg.inv(poses), np.float64)
        return np.array([self._predicted_db(poses, inverses, frame, reach) for frame in frames])

    def _predicted_db(self, poses: FloatArray, inverses: FloatArray, frame: int, reach: int) -> float:
        local, own = self._points(frame)
        values, distances = np.zeros((2, len(local))), np.full((2, len(local)), np.inf)
        for side, beside in enumerate((frame - reach, frame + reach)):
            onto = inverses[beside] @ poses[frame]
            points = local @ onto[:3, :3].T + onto[:3, 3]
            inside, values[side, inside] = seen_by_frame(self.sweep, beside, points, interpolated_sharply)
            distances[side, inside] = np.abs(points[inside, 1])
            if self.marks is not None:
                distances[side, np.flatnonzero(inside)[seen_by_frame(self.marks, 0, points)[1] > 0.0]] = np.inf
        predicted = blend_by_distance(values, distances)
        known = ~np.isnan(predicted)
        return _psnr_db(predicted[known], own[known])

    def crossing_db(self, poses: FloatArray) -> float | None:  # [F, 4, 4] mm
        """Of the pixels that frames of other passes show, too, as the nearest of those does; None where few are."""
        inverses, normals = np.linalg.inv(poses), poses[:, :3, 1]
        offsets = np.einsum("fi,fi->f", normals, poses[:, :3, 3])
        predicted, actual = [], []
        for frame in self.frames[spread_places(len(self.frames), CROSSING_FRAMES)]:
            local, own = (some[:CROSSING_PIXELS] for some in self._points(frame))
            places = local @ poses[frame, :3, :3].T + poses[frame, :3, 3]
            heights = np.abs(places @ normals.T - offsets)  # [N, F]
            heights[:, self.passes == self.passes[frame]] = np.inf
            nearest = np.where(heights.min(axis=1) <= CROSSING_MM, heights.argmin(axis=1), -1)
            for beside in np.unique(nearest[nearest >= 0]):
                some, onto = nearest == beside, inverses[beside]
                points = places[some] @ onto[:3, :3].T + onto[:3, 3]
                inside, values = seen_by_frame(self.sweep, beside, points, interpolated_sharply)
                predicted.append(values)
                actual.append(own[some][inside])
        if sum(map(len, actual)) < LEAST_CROSSING:
            return None
        return _psnr_db(np.concatenate(predicted), np.concatenate(actual))

    def in_time_db(self) -> float:
        """Of the pixels as blends of the same pixels of the two frames, by their times."""
        times, psnrs_db = frame_times(self.sweep), []
        for frame in self.frames:
            before, middle, after = (self._values(one, *self._pixels(frame)) for one in (frame - 1, frame, frame + 1))
            span = times[frame + 1] - times[frame - 1]
            share = (times[frame] - times[frame - 1]) / span if span > 0.0 else 0.5
            psnrs_db.append(_psnr_db(blend_in_time(before, after, float(np.clip(share, 0.0, 1.0))), middle))
        return float(np.mean(psnrs_db))

    def _points(self, frame: int) -> tuple[FloatArray, FloatArray]:  # [N, 3] mm, [N]
        """Pixels of a frame, in the frame of its probe, and what it shows there; kept for the next path."""
        if frame not in self._known_points:
            rows, columns = self._pixels(frame)
            sweep = self.sweep
            local = sweep.probe.points_mm((rows + 0.5) / sweep.height, (columns + 0.5) / sweep.width)
            self._known_points[frame] = local, self._values(frame, rows, columns)
        return self._known_points[frame]

    def _pixels(self, frame: int) -> tuple[IntArray, IntArray]:  # [N] rows, [N] columns
        """Beside marks."""
        random = np.random.default_rng(frame)
        rows, columns = (random.integers(size, size=PIXELS) for size in self.sweep.images.shape[1:])
        if self.marks is None:
            return rows, columns
        beside = self.marks.images[0, rows, columns] == 0
        return rows[beside], columns[beside]

    def _values(self, frame: int, rows: IntArray, columns: IntArray) -> FloatArray:  # [N]
        values: FloatArray = self.sweep.images[frame, rows, columns].astype(np.float64)
        return values


def _marks_of(sweep: Sweep) -> Sweep | None:
    """What is burnt into all images, such as text, as one picture of a sweep: it says that nothing moves."""
    marks = burnt_in(sweep.images, len(sweep))
    if not marks:
        return None
    bright = np.zeros(sweep.images.shape[1:], np.uint8)
    for mark in marks:
        bright[mark.box][mark.pixels] = 255
    grown = cv2.dilate(bright, np.ones((MARK_MARGIN, MARK_MARGIN), np.uint8))
    return replace(sweep.select([0]), images=grown[None].astype(np.uint8))


def _psnr_db(predicted: FloatArray, true: FloatArray) -> float:  # [N] of 255, both; none: 0 dB
    squared = np.square(predicted - true).mean() if len(true) else 255.0**2
    return float(-10.0 * np.log10(max(squared / 255.0**2, 1e-10)))
