"""Tissue that goes along with a probe that presses and drags it: from poses as tracked to the tissue at rest.

A scene is the tissue at rest. Where a sweep's images moved less within their plane than its poses did
(`ultragray.learn.training.agreement`), each training frame has two poses: the one that its tracker told, and the one
at which the tissue at rest looks as that frame does. A pose that is asked for is compared with the tracked frames
beside it, and brought to the same place beside those at rest. Of the way from there, within the image plane, the
tissue goes along with its share as long as that is no longer than the tracker errs; beyond, the probe slides over it.
Free of torch.
"""

from __future__ import annotations

import numpy as np

from ultragray.geometry.probe import FloatArray, Probe
from ultragray.geometry.rotations import rotations_of, turns_of

NEIGHBOURS = 8  # frames of which a place is told
STICKING = 3.0  # standard deviations of the tracker's errors: as far does tissue go along with a pose off the path
LEAST_SPACING_MM = 1e-3
_WITHIN_THE_PLANE = (0, 2, 4)  # of a way: shift along the lateral and the axial axis, turn about the elevation axis


class FollowingTissue:
    """The way between poses as tracked and poses in the tissue at rest, of one scene."""

    def __init__(
        self,
        tracked: FloatArray,  # [P, 4, 4] mm, the path of the training frames without the tracker's errors
        at_rest: FloatArray,  # [P, 4, 4] mm
        errors: FloatArray | None,  # [P, 4, 4] tracked = errors · poses as the tracker told them; None: no errors
        shares: tuple[float, float, float],  # of the motion within the plane (lateral, axial, turn) that tissue sees
        probe: Probe,
    ) -> None:
        self._tracked, self._at_rest, self._shares = tracked, at_rest, np.asarray(shares)
        self._probe, self._middle = probe, probe.corners_mm().mean(axis=0)
        self._sticking = np.zeros(3)
        if errors is not None:
            told = np.linalg.inv(errors) @ tracked
            ways = self._ways(self._beside(told, tracked, tracked), told)[:, _WITHIN_THE_PLANE]
            self._sticking = STICKING * np.sqrt(np.square(ways).mean(axis=0))

    def at_rest(self, poses: FloatArray) -> FloatArray:  # [C, 4, 4] mm -> [C, 4, 4] mm
        """Where the tissue at rest looks as it does from these poses, as tracked."""
        ways = self._ways(self._beside(poses, self._tracked, self._tracked), poses)
        within = ways[:, _WITHIN_THE_PLANE]
        stuck = np.clip(within, -self._sticking, self._sticking)
        ways[:, _WITHIN_THE_PLANE] = within - (1.0 - self._shares) * stuck
        return self._moved(self._beside(poses, self._tracked, self._at_rest), ways)

    def tracked(self, poses: FloatArray) -> FloatArray:  # [C, 4, 4] mm -> [C, 4, 4] mm
        """The other way: poses as tracked, of poses in the tissue at rest over which the probe slides."""
        ways = self._ways(self._beside(poses, self._at_rest, self._at_rest), poses)
        return self._moved(self._beside(poses, self._at_rest, self._tracked), ways)

    def _beside(self, poses: FloatArray, path: FloatArray, wanted: FloatArray) -> FloatArray:  # [C, 4, 4] mm
        """The poses of `wanted` [P, 4, 4] where `path` [P, 4, 4] is nearest: means in which near frames weigh most."""
        corners, asked = self._probe.corners_from(path), self._probe.corners_from(poses)
        squares = np.square(asked[:, None] - corners).sum(axis=-1).mean(axis=-1)  # [C, P]
        nearest = np.argsort(squares, axis=1, kind="stable")[:, :NEIGHBOURS]  # [C, n]
        squares = np.take_along_axis(squares, nearest, axis=1)
        weights = np.exp(-0.5 * (squares - squares[:, :1]) / self._spacing_mm(corners) ** 2)
        weights /= weights.sum(axis=1, keepdims=True)
        chosen = wanted[nearest]  # [C, n, 4, 4]
        ways = self._ways(np.repeat(chosen[:, 0], nearest.shape[1], axis=0), chosen.reshape(-1, 4, 4))
        return self._moved(chosen[:, 0], (weights[..., None] * ways.reshape(*nearest.shape, 6)).sum(axis=1))

    @staticmethod
    def _spacing_mm(corners: FloatArray) -> float:  # [P, K, 3]
        steps = np.sqrt(np.square(np.diff(corners, axis=0)).sum(axis=-1).mean(axis=-1))
        return max(float(np.median(steps)), LEAST_SPACING_MM) if len(steps) else LEAST_SPACING_MM

    def _ways(self, before: FloatArray, after: FloatArray) -> FloatArray:  # [C, 4, 4] both -> [C, 6]
        """From one pose to another along the axes of the first: shift of the middle of the image, mm, and turn, rad."""
        motions = np.linalg.inv(before) @ after
        shifts = motions[:, :3, :3] @ self._middle + motions[:, :3, 3] - self._middle
        return np.concatenate([shifts, turns_of(motions[:, :3, :3])], axis=1)

    def _moved(self, poses: FloatArray, ways: FloatArray) -> FloatArray:  # [C, 4, 4], [C, 6] -> [C, 4, 4]
        motions = np.tile(np.eye(4), (len(poses), 1, 1))
        motions[:, :3, :3] = rotations_of(ways[:, 3:])
        motions[:, :3, 3] = self._middle + ways[:, :3] - motions[:, :3, :3] @ self._middle
        moved: FloatArray = poses @ motions
        return moved
