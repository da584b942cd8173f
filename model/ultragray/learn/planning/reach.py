"""The poses in reach: on the skin under a scene's training views, looking in within some angles.

The face's middle lies on the skin. At rest the probe looks along the smoothed normal there, its lateral axis as near to
that of the training views as can be; then R = R₀ · Rx(tilt) · Ry(rock) · Rz(turn). Places and angles come from a
sequence of low discrepancy, so that the same reach is always the same poses, and a part of them is spread as evenly as
all are.
"""

from __future__ import annotations

from itertools import product

import cv2
import numpy as np

from ultragray.errors import InvalidArgument
from ultragray.geometry.probe import BoolArray, FloatArray, Probe
from ultragray.geometry.rotations import about_axes, transforms_of
from ultragray.geometry.scan_conversion import interpolated
from ultragray.learn.planning.settings import Box, PlanSettings, box_of
from ultragray.rendering.contact import Skin, Touch

CANDIDATES = 1024
LEAST_CONTACT = 0.9  # share of the scan lines
SMOOTHED_MM = 8.0  # standard deviation: heights of the skin whose slope a probe is held by
_LINES = 16  # by which contact is judged
_ROUNDS = 8  # of CANDIDATES, until enough are in reach


def evenly_spread(count: int, dimensions: int, first: int = 0) -> FloatArray:  # [count, dimensions] in [0, 1)
    """Points number `first` and on of Roberts' sequence R_d: multiples of 1/g, 1/g², … mod 1, where g^(d+1) = g + 1."""
    root = 2.0
    for _ in range(40):  # a fixed point
        root = (1.0 + root) ** (1.0 / (dimensions + 1))
    points: FloatArray = (
        0.5 + np.arange(first + 1, first + count + 1)[:, None] / root ** np.arange(1, dimensions + 1)
    ) % 1.0
    return points


def poses_in_reach(
    training_poses: FloatArray, known: Probe | None, probe: Probe, settings: PlanSettings, plane: FloatArray | None
) -> FloatArray:  # [P, 4, 4] mm, [4] -> [C, 4, 4] mm
    """At most CANDIDATES poses of a probe on the skin under training views of the probe `known`.

    Half of them lie in the `plane` n·x = d where one is given and the angles allow it. Raises InvalidArgument where no
    skin is known under the scene, and where no pose is in reach.
    """
    try:
        skin = Skin.under(training_poses, known)
    except InvalidArgument as error:
        raise InvalidArgument(
            f"{error.detail.replace('contact', 'a reach on the skin', 1)}: name the poses", field="poses"
        ) from None
    surface = _Surface(skin)
    box = None if settings.box_mm is None else box_of(settings.box_mm, "box_mm")
    blocks: list[FloatArray] = []
    for number in range(_ROUNDS):
        spread = evenly_spread(CANDIDATES, 5, first=number * CANDIDATES)
        places = surface.places(spread[:, :2], box)
        angles = np.radians((settings.tilt_deg, settings.rock_deg, settings.turn_deg)) * (2.0 * spread[:, 2:] - 1.0)
        candidates = _poses(surface, places, angles, probe)
        if plane is not None:
            in_plane = _moved_into(plane, surface, candidates[::2], probe, settings)
            candidates = np.concatenate([in_plane, candidates[1::2]])
        blocks.append(candidates[_allowed(skin, probe, candidates, settings)])
        if sum(map(len, blocks)) >= CANDIDATES:
            break
    poses = np.concatenate(blocks)[:CANDIDATES]
    if not len(poses):
        where = "" if box is None else " within box_mm"
        raise InvalidArgument(
            f"no pose is in reach: nowhere on the known skin{where} have {LEAST_CONTACT:.0%} of the scan lines contact "
            "at such angles",
            field="box_mm" if settings.box_mm else "rock_deg",
        )
    return poses


class _Surface:
    """A skin and its smoothed slope."""

    def __init__(self, skin: Skin) -> None:
        self._skin = skin
        smooth = cv2.GaussianBlur(skin.outermost, (0, 0), SMOOTHED_MM / skin.cell_mm)
        self._slopes = [np.gradient(smooth, skin.cell_mm, axis=axis) for axis in (1, 0)]  # along x, y

    def places(self, shares: FloatArray, box: Box | None) -> FloatArray:  # [C, 2] in [0, 1) -> [C, 2]: x, y in cells
        """Places over the skin's cells, or over those that a box may hold."""
        rows, columns = self._skin.outermost.shape
        low, high = np.zeros(2), np.array([columns - 1.0, rows - 1.0])
        if box is not None:
            corners = self.below(np.array(list(product(*zip(*box, strict=True)))))
            low, high = np.clip(corners.min(axis=0), low, high), np.clip(corners.max(axis=0), low, high)
        return low + shares * (high - low)

    def at(self, places: FloatArray) -> tuple[FloatArray, FloatArray]:  # [C, 2] -> [C, 3] mm, [C, 3, 3]
        """Points of the skin, and the rotations R₀ of a probe that looks straight in there."""
        skin = self._skin
        rows, columns = skin.outermost.shape
        x, y = np.clip(places[:, 0], 0.0, columns - 1.001), np.clip(places[:, 1], 0.0, rows - 1.001)
        height, along, across = (interpolated(field, y, x) for field in (skin.outermost, *self._slopes))
        points = skin.origin + np.stack([x * skin.cell_mm, y * skin.cell_mm, height], axis=1) @ skin.axes
        inward = np.stack([along, across, -np.ones_like(along)], axis=1) @ skin.axes
        return points, _upright(inward, np.broadcast_to(skin.axes[0], inward.shape))

    def below(self, points: FloatArray) -> FloatArray:  # [C, 3] mm -> [C, 2]
        """The places over or under points."""
        skin = self._skin
        places: FloatArray = ((points - skin.origin) @ skin.axes.T)[:, :2] / skin.cell_mm
        return places


def _upright(axial: FloatArray, lateral: FloatArray) -> FloatArray:  # [C, 3] both -> [C, 3, 3]
    """Rotations with this axial axis, and a lateral one as near to the other as can be."""
    axial = axial / np.linalg.norm(axial, axis=1, keepdims=True)
    lateral = lateral - (lateral * axial).sum(axis=1, keepdims=True) * axial
    lateral = lateral / np.linalg.norm(lateral, axis=1, keepdims=True)
    return np.stack([lateral, np.cross(axial, lateral), axial], axis=2)


def _poses(surface: _Surface, places: FloatArray, angles: FloatArray, probe: Probe) -> FloatArray:  # [C, 2], [C, 3] rad
    points, straight = surface.at(places)
    turns = [
        about_axes(np.tile(axis, (len(angles), 1)), angle) for axis, angle in zip(np.eye(3), angles.T, strict=True)
    ]
    return _with_faces(points, straight @ turns[0] @ turns[1] @ turns[2], probe)


def _with_faces(points: FloatArray, rotations: FloatArray, probe: Probe) -> FloatArray:  # [C, 3], [C, 3, 3]
    """Poses [C, 4, 4] whose faces have their middles at points."""
    return transforms_of(rotations, points - probe.pivot_depth_mm * rotations[:, :, 2])


def _faces(poses: FloatArray, probe: Probe) -> FloatArray:  # [C, 4, 4] -> [C, 3] mm
    faces: FloatArray = poses[:, :3, 3] + probe.pivot_depth_mm * poses[:, :3, 2]
    return faces


def _moved_into(
    plane: FloatArray, surface: _Surface, poses: FloatArray, probe: Probe, settings: PlanSettings
) -> FloatArray:  # [4], [C, 4, 4] -> [≤ C, 4, 4]
    """Poses moved along the skin into a plane and turned so that their images lie in it, where the angles allow it."""
    normal, faces = plane[:3], _faces(poses, probe)
    _, straight = surface.at(surface.below(faces))
    along = normal - (straight[:, :, 2] @ normal)[:, None] * straight[:, :, 2]  # within the skin
    slope = (along * along).sum(axis=1, keepdims=True)
    faces = faces - (faces @ normal - plane[3])[:, None] * along / np.maximum(slope, 1e-6)
    faces, straight = surface.at(surface.below(faces))
    faces = faces - (faces @ normal - plane[3])[:, None] * normal  # what a curved skin leaves, less than its coupling
    elevation = np.where((poses[:, :3, 1] @ normal)[:, None] < 0.0, -normal, normal)
    axial = straight[:, :, 2] - (straight[:, :, 2] * elevation).sum(axis=1, keepdims=True) * elevation
    axial = axial / np.maximum(np.linalg.norm(axial, axis=1, keepdims=True), 1e-6)
    rotations = np.stack([np.cross(elevation, axial), elevation, axial], axis=2)
    relative = straight.transpose(0, 2, 1) @ rotations  # Rx(tilt) · Ry(rock) · Rz(turn)
    tilt = np.arctan2(-relative[:, 1, 2], relative[:, 2, 2])
    rock = np.arcsin(np.clip(relative[:, 0, 2], -1.0, 1.0))
    turn = np.arctan2(-relative[:, 0, 1], relative[:, 0, 0])
    most = np.array([settings.tilt_deg, settings.rock_deg, settings.turn_deg]) + 1e-6
    fits = (np.degrees(np.abs(np.stack([tilt, rock, turn], axis=1))) <= most).all(axis=1) & (slope[:, 0] > 1e-6)
    return _with_faces(faces[fits], rotations[fits], probe)


def _allowed(skin: Skin, probe: Probe, poses: FloatArray, settings: PlanSettings) -> BoolArray:  # [C]
    touching: BoolArray = Touch.of(skin, probe, poses, _LINES).shares >= LEAST_CONTACT
    return touching & within_box(poses, probe, settings)


def within_box(poses: FloatArray, probe: Probe, settings: PlanSettings) -> BoolArray:  # [C, 4, 4] mm -> [C]
    """Whether the middle of the probe's face lies in the box that is asked for, if one is."""
    if settings.box_mm is None:
        return np.ones(len(poses), bool)
    (low, high), faces = box_of(settings.box_mm, "box_mm"), _faces(poses, probe)
    return np.asarray(((faces >= low) & (faces <= high)).all(axis=1), bool)
