"""What the environments scan: their settings, motions of many probes at once, and the frames that these see of a scene.

From actions to rewards: `vector` moves the probes → `Site.look` renders what they see → `tasks` judge it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ultragray.contract import Contract, described
from ultragray.errors import InvalidArgument, InvalidImageSize
from ultragray.geometry.image_size import MAX_IMAGE_SIDE
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import BoolArray, FloatArray, Probe
from ultragray.geometry.rotations import about_axes, random_directions, rotation_angles_deg, rotations_of
from ultragray.rendering.confidence import supported_shares
from ultragray.rendering.contact import Touch
from ultragray.rendering.frames import render, render_grey, touch_of
from ultragray.rendering.pixels import to_uint8
from ultragray.rendering.settings import Contact
from ultragray.rendering.tools import Tool
from ultragray.scene.confidence import SUPPORT_COVERAGE, Assessor, Extrapolation, is_confident
from ultragray.scene.gaussians import GaussianScene

_ROOM_MM, _ROOM_DEG = 10.0, 10.0  # beyond twice the farthest start


class LowConfidence(str, Enum):
    """What becomes of frames whose confidence is below the least."""

    PENALTY = "penalty"
    MASK = "mask"


@dataclass(frozen=True, kw_only=True)
class ScanSettings(Contract):
    """Settings of the environments. Raises InvalidArgument, InvalidImageSize."""

    height: int = described("Depth samples.", 128, low=8, high=MAX_IMAGE_SIDE, error=InvalidImageSize)
    width: int = described("Scan lines.", 128, low=8, high=MAX_IMAGE_SIDE, error=InvalidImageSize)
    start_mm: float = described("An episode begins at most so far from the start of its task.", 15.0, low=0.0, high=1e3)
    start_deg: float = described("And turned by at most so much.", 15.0, low=0.0, high=90.0)
    step_mm: float = described("Largest shift of an action along each axis.", 2.0, above=0.0, high=100.0)
    step_deg: float = described("Largest turn of an action about each axis.", 2.0, above=0.0, high=45.0)
    reached_mm: float = described("So near to the goal, an episode ends.", 1.0, low=0.0, high=100.0)
    reached_deg: float = described("And turned from it by at most so much.", 2.0, low=0.0, high=90.0)
    contact: Contact | None = described(
        "air: scan lines whose face is off the skin are dark. pressure: and tissue gives way to a face that is pressed "
        "in, and to needles. None: contact is assumed.",
        Contact.AIR,
    )
    with_pose: bool = described("Observe the pose beside the frame.", False)
    label: str = described("The structure that is followed, or reached with a needle: a name of the scene's.", "vessel")
    min_confidence: float | None = described(
        "Frames of less confidence are trusted less, by low_confidence. Default: confidence is left out.",
        None,
        low=0.0,
        high=1.0,
    )
    low_confidence: LowConfidence = described(
        "penalty: what a frame lacks of min_confidence, as a share of it, is taken off the reward. mask: its pixels "
        "without support are black.",
        LowConfidence.PENALTY,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.min_confidence is None and self.low_confidence is LowConfidence.MASK:
            raise InvalidArgument("low_confidence mask needs min_confidence", field="min_confidence")

    @property
    def reach_mm(self) -> float:
        """The farthest that the probe gets from where its task is."""
        return 2.0 * self.start_mm + _ROOM_MM

    @property
    def reach_deg(self) -> float:
        """The most that it can be turned from there."""
        return min(2.0 * self.start_deg + _ROOM_DEG, 180.0)


# Motions of probes in their own frames, about the middles of their faces.


def moved(poses: FloatArray, shifts_mm: FloatArray, turns_deg: FloatArray, pivot_mm: float) -> FloatArray:
    """Poses [C, 4, 4] shifted along and turned about the probe's axes, [C, 3] both: lateral, elevation, axial.

    A turn is an axis times an angle, about the point at depth `pivot_mm` on the probe's axis.
    """
    return _displaced(poses, shifts_mm, rotations_of(np.radians(turns_deg)), pivot_mm)


def random_motions(
    random: np.random.Generator, pose: FloatArray, count: int, most_mm: float, most_deg: float, pivot_mm: float
) -> FloatArray:  # [4, 4] -> [count, 4, 4]
    """A pose shifted at random, uniform in a ball, and turned about random axes by uniform angles."""
    shifts = random_directions(random, count) * most_mm * random.random((count, 1)) ** (1.0 / 3.0)
    turns = about_axes(random_directions(random, count), np.radians(most_deg) * random.random(count))
    return _displaced(np.broadcast_to(pose, (count, 4, 4)), shifts, turns, pivot_mm)


def _displaced(poses: FloatArray, shifts_mm: FloatArray, rotations: FloatArray, pivot_mm: float) -> FloatArray:
    pivot = np.array([0.0, 0.0, pivot_mm])
    motions = np.zeros((len(poses), 4, 4))
    motions[:, :3, :3] = rotations
    motions[:, :3, 3] = shifts_mm + pivot - rotations @ pivot
    motions[:, 3, 3] = 1.0
    displaced: FloatArray = poses @ motions
    return displaced


@dataclass(frozen=True, eq=False)
class View:
    """What probes at K poses see."""

    poses: FloatArray  # [K, 4, 4] mm
    frames: Tensor  # [K, H, W] uint8, where the scene is
    lines: BoolArray  # [K, W]: scan lines with contact
    confidences: FloatArray | None  # [K]; None where they are left out

    @property
    def contact_shares(self) -> FloatArray:  # [K]
        shares: FloatArray = self.lines.mean(axis=1)
        return shares


START_CONTACT = 0.5  # the least share of contact at a start
_DRAWN = 16  # starts at once, of which the first with contact is taken
_MOST_DRAWN = 12  # times


class Site:
    """One scene as environments see it."""

    def __init__(self, scene: GaussianScene, probe: Probe | None, settings: ScanSettings) -> None:
        self.scene, self.probe, self.settings = scene, scene.info.probe_or(probe), settings
        self._assessor = Assessor(scene.info, scene.training_poses)

    def look(self, poses: FloatArray, tools: Sequence[tuple[Tool, ...]] = (), *, judged: bool = True) -> View:
        """What probes at poses [K, 4, 4] see; with `tools` each pose has its own. Contact and confidence may be left
        out, as for the frame of a goal. Raises what `render` raises.
        """
        settings = self.settings
        contact = settings.contact if judged else None
        watched = judged and settings.min_confidence is not None
        masked = watched and settings.low_confidence is LowConfidence.MASK
        if contact is not Contact.PRESSURE and not masked and not any(tools):
            plain = self._plain_look(poses, contact, watched)
            if plain is not None:
                return plain
        options: dict[str, Any] = {
            "height": settings.height,
            "width": settings.width,
            "outputs": ("bmode", "coverage") if watched else ("bmode",),
            "contact": contact,
        }
        with torch.no_grad():
            if any(tools):
                each = [
                    render(self.scene, self.probe, one, tools=own, **options)
                    for one, own in zip(poses, tools, strict=True)
                ]
            else:
                each = [render(self.scene, self.probe, poses, **options)]
            bmode = _together([frames["bmode"] for frames in each])
            lines = np.ones((len(poses), settings.width), np.bool_)
            if contact is not None:
                lines = np.concatenate([frames.touch.lines for frames in each if frames.touch is not None])
            confidences = None
            if watched:
                coverage = _together([frames["coverage"] for frames in each])
                extrapolations = self._judged(poses, supported_shares(coverage).tolist())
                if masked:
                    least = settings.min_confidence or 0.0
                    low = torch.tensor([not is_confident(one, least) for one in extrapolations], device=bmode.device)
                    bmode.masked_fill_(low[:, None, None] & (coverage < SUPPORT_COVERAGE), 0.0)
                confidences = _confidences(extrapolations)
        return View(poses, _grey(bmode), lines, confidences)

    def _plain_look(self, poses: FloatArray, contact: Contact | None, watched: bool) -> View | None:  # [K, 4, 4]
        """Frames into which nothing is put but what air darkens, in one pass; None where the scene has no such pass."""
        size = self.settings.height, self.settings.width
        touch = None if contact is None else self.touch(poses)
        grey = render_grey(self.scene, self.probe, poses, height=size[0], width=size[1], touch=touch)
        if grey is None:
            return None
        lines = np.ones((len(poses), size[1]), np.bool_) if touch is None else touch.lines
        confidences = _confidences(self._judged(poses, grey.supported.tolist())) if watched else None
        return View(poses, grey.bmode, lines, confidences)

    def _judged(self, poses: FloatArray, shares: list[float]) -> list[Extrapolation]:  # [K, 4, 4], [K] -> [K]
        """How far frames, of whose pixels such shares have support, are from what the scene was trained on."""
        return self._assessor.with_support(self._assessor.assess(poses, self.probe), shares)

    def random_starts(self, around: FloatArray, randoms: Sequence[np.random.Generator]) -> FloatArray:  # [4, 4]
        """A pose around another for each of K generators, [K, 4, 4]: of all that were drawn, the first with enough
        contact, else the one with the most.
        """
        settings, pivot_mm = self.settings, self.probe.pivot_depth_mm
        starts, most = np.broadcast_to(around, (len(randoms), 4, 4)).copy(), np.full(len(randoms), -1.0)
        sought = np.arange(len(randoms))
        for _ in range(_MOST_DRAWN):
            far = settings.start_mm, settings.start_deg
            drawn = np.stack([random_motions(randoms[one], around, _DRAWN, *far, pivot_mm) for one in sought.tolist()])
            if settings.contact is None:
                return drawn[:, 0]
            shares = self.touch(drawn.reshape(-1, 4, 4)).shares.reshape(-1, _DRAWN)
            chosen = np.where(
                shares.max(axis=1) >= START_CONTACT, (shares >= START_CONTACT).argmax(axis=1), shares.argmax(axis=1)
            )
            rows = np.arange(len(sought))
            share = shares[rows, chosen]
            better = share > most[sought]
            starts[sought[better]], most[sought[better]] = drawn[rows, chosen][better], share[better]
            sought = sought[most[sought] < START_CONTACT]
            if not len(sought):
                break
        return starts

    def touch(self, poses: FloatArray) -> Touch:  # [K, 4, 4]
        return touch_of(self.scene, self.probe, poses, self.settings.width)

    def between(self, poses: FloatArray, others: FloatArray) -> tuple[FloatArray, FloatArray]:  # [K, 4, 4], [P, 4, 4]
        """Distances of the middles of the faces, mm, and angles of the turns, degrees: [K, P] both."""
        middle = np.array([0.0, 0.0, self.probe.pivot_depth_mm, 1.0])
        faces, other_faces = (poses @ middle)[:, None, :3], (others @ middle)[None, :, :3]
        return np.linalg.norm(faces - other_faces, axis=2), rotation_angles_deg(poses, others)

    def in_probe_frame(self, poses: FloatArray, points: FloatArray) -> FloatArray:  # [K, 4, 4], [P, 3] -> [K, P, 3] mm
        return (points - poses[:, None, :3, 3]) @ poses[:, :3, :3]

    def points_mm(self, label: str | None = None) -> FloatArray:  # [P, 3]
        """The middles of all Gaussians, or of those with a label. Raises InvalidArgument for one the scene lacks."""
        scene = self.scene
        points = np.asarray(scene.info.centre_mm) + 10.0 * scene.means.detach().cpu().double().numpy()
        if label is None:
            return points
        numbers = [number for number, name in scene.info.label_names.items() if name == label]
        if scene.labels is None or not numbers:
            known = ", ".join(scene.info.label_names.values()) or "none"
            raise InvalidArgument(
                f"label must be a name that the scene gives its Gaussians ({known}), got {label!r}", field="label"
            )
        chosen_points: FloatArray = points[scene.labels.cpu().numpy() == numbers[0]]
        return chosen_points


def _confidences(extrapolations: Sequence[Extrapolation]) -> FloatArray:  # [K]
    """0 where it is unknown."""
    return np.array([one.confidence or 0.0 for one in extrapolations])


def _together(parts: Sequence[Tensor]) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(list(parts))


def _grey(bmode: Tensor) -> Tensor:  # [K, H, W] in [0, 1] -> uint8
    """Rounded as `to_uint8` does, where the frames are."""
    if bmode.device.type == "cpu":  # in one pass
        return torch.from_numpy(to_uint8(bmode.numpy()))
    return bmode.mul(255.0).round().clamp(max=255.0).byte()


def goal_of(scene: GaussianScene, goal: Any) -> FloatArray:  # [4, 4]
    """The pose of a goal: a pose, the number of a training view, or None, the one in the middle of the sweep.

    Raises InvalidArgument, InvalidPose.
    """
    views = scene.training_poses
    if goal is not None and (isinstance(goal, bool) or not isinstance(goal, (int, np.integer))):
        exact = check_poses(goal, field="goal")
        if len(exact) != 1:
            raise InvalidArgument(f"goal must be one pose [4, 4], got {len(exact)}", field="goal")
        one: FloatArray = exact[0]
        return one
    if not len(views):
        raise InvalidArgument("goal must be a pose: the scene holds no training poses", field="goal")
    number = len(views) // 2 if goal is None else int(goal)
    if not 0 <= number < len(views):
        raise InvalidArgument(
            f"goal must be a pose, or the number of a training view, 0 to {len(views) - 1}, got {number}", field="goal"
        )
    view: FloatArray = views[number].copy()
    return view
