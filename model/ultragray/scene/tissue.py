"""Tissue that goes along with a probe that presses and drags it: from poses as tracked to the tissue at rest.

A scene is the tissue at rest. Where a sweep's images moved less within their plane than its poses did
(`ultragray.learn.training.agreement`), each training frame has two poses: the one that its tracker told, and the one
at which the tissue at rest looks as that frame does. A pose that is asked for is compared with the tracked frames
beside it, and brought to the same place beside those at rest. Of the way from there, within the image plane, the
tissue goes along with its share as long as that is no longer than the tracker errs; beyond, the probe slides over it.
Free of torch.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from ultragray.geometry.probe import FloatArray, Probe
from ultragray.geometry.rotations import rotations_of, turns_of

NEIGHBOURS = 8  # frames of which a place is told
STICKING = 3.0  # standard deviations of the tracker's errors: as far does tissue go along with a pose off the path
LEAST_SPACING_MM = 1e-3
POLAR_STEPS = 3  # of Newton's iteration for the rotation nearest to a matrix that is nearly one
PAIRS_AT_ONCE = 2**22  # of poses and training frames: bounds the memory
_WITHIN_THE_PLANE = (0, 2, 4)  # of a way: shift along the lateral and the axial axis, turn about the elevation axis


IntArray: TypeAlias = npt.NDArray[np.int64]


class FollowingTissue:
    """The way between poses as tracked and poses in the tissue at rest, of one scene."""

    def __init__(
        self,
        tracked: FloatArray,  # [P, 4, 4] mm, the path of the training frames without the tracker's errors
        at_rest: FloatArray,  # [P, 4, 4] mm
        errors: FloatArray | None,  # [P, 4, 4] tracked = errors · poses as the tracker gives them; None: no errors
        shares: tuple[float, float, float],  # of the motion within the plane (lateral, axial, turn) that tissue sees
        probe: Probe,
    ) -> None:
        self._shares, self._middle = np.asarray(shares), probe.corners_mm().mean(axis=0)
        self._tracked, self._at_rest = _Path(tracked, probe), _Path(at_rest, probe)
        self._sticking = np.zeros(3)
        if errors is not None:
            tracker_poses = np.linalg.inv(errors) @ tracked
            beside = self._tracked.at(*self._tracked.nearest(tracker_poses))
            ways = self._ways(beside, tracker_poses)[:, _WITHIN_THE_PLANE]
            self._sticking = STICKING * np.sqrt(np.square(ways).mean(axis=0))

    def at_rest(self, poses: FloatArray) -> FloatArray:  # [C, 4, 4] mm -> [C, 4, 4] mm
        """Where the tissue at rest looks as it does from these poses, as tracked."""
        place = self._tracked.nearest(poses)
        ways = self._ways(self._tracked.at(*place), poses)
        within = ways[:, _WITHIN_THE_PLANE]
        stuck = np.clip(within, -self._sticking, self._sticking)
        ways[:, _WITHIN_THE_PLANE] = within - (1.0 - self._shares) * stuck
        return self._moved(self._at_rest.at(*place), ways)

    def tracked(self, poses: FloatArray) -> FloatArray:  # [C, 4, 4] mm -> [C, 4, 4] mm
        """The other way: poses as tracked, of poses in the tissue at rest over which the probe slides."""
        place = self._at_rest.nearest(poses)
        return self._moved(self._tracked.at(*place), self._ways(self._at_rest.at(*place), poses))

    def _ways(self, before: FloatArray, after: FloatArray) -> FloatArray:  # [C, 4, 4] both -> [C, 6]
        """From one pose to another along the axes of the first: shift of the middle of the image, mm, and turn, rad."""
        back = before[:, :3, :3].transpose(0, 2, 1)
        shifts = back @ (_points(after, self._middle) - _points(before, self._middle))[..., None]
        return np.concatenate([shifts[..., 0], turns_of(back @ after[:, :3, :3])], axis=1)

    def _moved(self, poses: FloatArray, ways: FloatArray) -> FloatArray:  # [C, 4, 4], [C, 6] -> [C, 4, 4]
        moved = poses.copy()
        moved[:, :3, :3] = poses[:, :3, :3] @ rotations_of(ways[:, 3:])
        middles = _points(poses, self._middle + ways[:, :3])
        moved[:, :3, 3] = middles - moved[:, :3, :3] @ self._middle
        return moved


def _points(poses: FloatArray, local: FloatArray) -> FloatArray:  # [C, 4, 4], [3] or [C, 3] -> [C, 3]
    points: FloatArray = (poses[:, :3, :3] @ local[..., None])[..., 0] + poses[:, :3, 3]
    return points


class _Path:
    """Poses [P, 4, 4] (mm) of frames, and places beside them, told by the corners of the images."""

    def __init__(self, poses: FloatArray, probe: Probe) -> None:
        self._poses, self._probe = poses, probe
        corners = probe.corners_from(poses)  # [P, K, 3]
        self._centre, self._corner_count = corners.mean(axis=(0, 1)), corners.shape[1]
        self._corners = (corners - self._centre).reshape(len(poses), -1)
        self._squares = np.square(self._corners).sum(axis=1)
        steps = np.sqrt(np.square(np.diff(self._corners, axis=0)).sum(axis=1) / self._corner_count)
        self._spacing_mm = max(float(np.median(steps)) if len(steps) else 0.0, LEAST_SPACING_MM)

    def nearest(self, poses: FloatArray) -> tuple[IntArray, FloatArray]:  # [C, 4, 4] mm -> [C, n] both
        """The frames nearest to each pose, and their weights, of which the sum is 1."""
        count = min(NEIGHBOURS, len(self._poses))
        frames, squares = np.empty((len(poses), count), np.int64), np.empty((len(poses), count))
        at_once = max(1, PAIRS_AT_ONCE // len(self._poses))
        for first in range(0, len(poses), at_once):
            some = slice(first, first + at_once)
            corners = (self._probe.corners_from(poses[some]) - self._centre).reshape(-1, self._corners.shape[1])
            distances = self._squares - 2.0 * corners @ self._corners.T  # squared, less a number that each pose has
            frames[some] = np.argpartition(distances, count - 1, axis=1)[:, :count]
            squares[some] = np.take_along_axis(distances, frames[some], axis=1) / self._corner_count
        squares -= squares.min(axis=1, keepdims=True)
        weights = np.exp(-0.5 * squares / self._spacing_mm**2)
        return frames, weights / weights.sum(axis=1, keepdims=True)

    def at(self, frames: IntArray, weights: FloatArray) -> FloatArray:  # [C, n] both -> [C, 4, 4] mm
        """The weighted means of frames that are turned nearly alike."""
        poses: FloatArray = np.einsum("cn,cnij->cij", weights, self._poses[frames])
        for _ in range(POLAR_STEPS):
            turn = poses[:, :3, :3]
            poses[:, :3, :3] = 1.5 * turn - 0.5 * turn @ turn.transpose(0, 2, 1) @ turn
        return poses
