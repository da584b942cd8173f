"""What environments are rewarded for: a standard plane, coverage, following a vessel, reaching it with a needle.

A task belongs to one site and keeps the state of its K environments in arrays. `vector` asks it where episodes start,
which tools the frames show, and what a view is worth.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from ultragray.errors import InvalidArgument
from ultragray.geometry.probe import BoolArray, FloatArray
from ultragray.rendering.tools import Needle, Tool, ToolFrame
from ultragray_studies.gym.scan import Site, View

REACHED_CONTACT = 0.9  # of the contact that the goal has, without which it is not reached


class TaskName(str, Enum):
    """What an environment is for."""

    STANDARD_PLANE = "standard plane"
    COVERAGE = "coverage"
    VESSEL = "vessel"
    NEEDLE = "needle"


@dataclass(frozen=True, eq=False)
class Judgement:
    """What K views are worth."""

    rewards: Tensor  # [K], where the frames are
    is_done: BoolArray  # [K]
    infos: dict[str, Any] = field(default_factory=dict)  # [K, ...] each, beside what every task tells


class Task:
    """Base of the tasks. `posts` [P, 4, 4]: poses about which the probe stays; about the first of them it starts."""

    name: ClassVar[TaskName]
    action_size: ClassVar[int] = 6
    members: ClassVar[dict[TaskName, type[Task]]] = {}

    def __init_subclass__(cls) -> None:
        cls.members[cls.name] = cls

    def __init__(self, site: Site, goal: FloatArray, count: int) -> None:  # [4, 4] mm
        self.site, self.goal, self.posts = site, goal, goal[None]

    def begin(self, which: BoolArray) -> None:  # [K]
        """Episodes that start anew."""

    def act(self, which: BoolArray, more: FloatArray) -> None:  # [K], [K, action_size - 6] from -1 to 1
        """Actions beyond the motion of the probe."""

    def tools(self, which: BoolArray) -> list[tuple[Tool, ...]]:
        """What the frames of these environments show beside the tissue; empty: nothing in any."""
        return []

    def judge(self, which: BoolArray, view: View) -> Judgement:
        """The worth of what the environments of a mask see, in their order."""
        raise NotImplementedError


def _contact_of(view: View) -> Tensor:  # [K]: share of contact - 1
    return torch.from_numpy(view.contact_shares - 1.0).float().to(view.frames.device)


def _tensor(values: FloatArray, like: Tensor) -> Tensor:
    return torch.from_numpy(values).float().to(like.device)


COARSE = 8  # pixels of a side that are averaged
LEAST_CONTRAST = 1e-5  # of the square of a frame's brightness: what varies less is rounding
TOGETHER = 16  # frames that are compared at once by the CPU: as many as its cache holds as floats


class Target:
    """A frame that others are compared with: quick, and telling from afar."""

    def __init__(self, frame: Tensor) -> None:  # [H, W] uint8
        means = [_means_of(side) for side in frame.shape]
        self._means: list[Any] = [one.to(frame.device) if frame.is_cuda else one.numpy() for one in means]
        centred = [rows[0] - rows[0].mean() for rows in self._rows_of(frame[None])]
        self._parts = [part / (part @ part) ** 0.5 for part in centred]

    def similarity(self, frames: Tensor) -> Tensor:  # [K, H, W] uint8 -> [K]
        """The mean of two correlations, from −1 to 1: of the frames, and of their means over 8x8 pixels.

        The first tells a frame that is the target's from one beside it, the second the way to it from some millimetres
        away. That of a frame without contrast, such as one without contact, is 0.
        """
        some = torch.split(frames, len(frames) if frames.is_cuda else TOGETHER)
        return torch.cat([torch.as_tensor(self._similarity(few)) for few in some])

    def _similarity(self, frames: Tensor) -> Any:  # [K, H, W] -> [K]
        fine, coarse = (_correlations(*both) for both in zip(self._rows_of(frames), self._parts, strict=True))
        return 0.5 * (fine + coarse)

    def _rows_of(self, frames: Tensor) -> tuple[Any, Any]:  # [K, H, W] -> [K, pixels] both
        """Frames, and their means over squares, pixels in a row: NumPy's, but of a GPU torch's."""
        # On a busy machine the threads of torch wait for each other several times as long as this takes.
        grey = frames.float() if frames.is_cuda else frames.numpy().astype(np.float32)
        along_rows, along_columns = self._means
        means = along_rows @ (grey @ along_columns.T)
        return grey.reshape(len(grey), -1), means.reshape(len(grey), -1)


def _means_of(side: int) -> Tensor:  # -> [side // COARSE, side]
    """The matrix that takes pixels to the means of each COARSE of them."""
    return interpolate(torch.eye(side)[None], size=max(1, side // COARSE), mode="area")[0].T.contiguous()


def _correlations(rows: Any, part: Any) -> Any:  # [K, pixels], [pixels] of mean 0 and length 1 -> [K]
    """Of the rows with a part; as that has no mean, theirs need not be taken off, which would cost another pass.

    Of arrays, and of tensors.
    """
    squares, means = (rows * rows).sum(axis=1), rows.mean(axis=1)
    variances = squares - rows.shape[1] * means * means
    correlations = (rows @ part) / variances.clip(min=1e-30) ** 0.5 * (variances > LEAST_CONTRAST * squares)
    return correlations.clip(-1.0, 1.0)  # rounding could take it beyond


class StandardPlane(Task):
    """Find the view of the goal.

    Reward: (similarity − 1) + (share of contact − 1), at most 0, and 0 only at the goal. Done within `reached_mm` and
    `reached_deg` of the goal, with 90% of its contact.
    """

    name = TaskName.STANDARD_PLANE

    def __init__(self, site: Site, goal: FloatArray, count: int) -> None:
        super().__init__(site, goal, count)
        self.frame = site.look(self.posts, judged=False).frames[0]
        if self.frame.min() == self.frame.max():
            raise InvalidArgument(
                "goal must be a pose, in mm, from which the scene shows something: its frame is black all over",
                field="goal",
            )
        contact = site.settings.contact
        self._contact = 1.0 if contact is None else float(site.touch(self.posts).shares[0])
        self._target = Target(self.frame)

    def judge(self, which: BoolArray, view: View) -> Judgement:
        settings, similarity = self.site.settings, self._target.similarity(view.frames)
        away_mm, turned_deg = (values[:, 0] for values in self.site.between(view.poses, self.posts))
        near = (away_mm <= settings.reached_mm) & (turned_deg <= settings.reached_deg)
        done = near & (view.contact_shares >= REACHED_CONTACT * self._contact)
        return Judgement(similarity - 1.0 + _contact_of(view), done, {"similarity": similarity})


class Coverage(Task):
    """See the tissue about the goal: all that lies in its image, and within `start_mm` before and behind it.

    A point is seen where a scan line with contact passes it, within SLICE_MM. Reward: the share of the region that is
    seen for the first time, in hundredths, + (share of contact − 1). Done when COVERED of the region was seen.
    """

    name = TaskName.COVERAGE
    POINTS = 2048
    SLICE_MM = 1.0
    COVERED = 0.95

    def __init__(self, site: Site, goal: FloatArray, count: int) -> None:
        super().__init__(site, goal, count)
        points = site.points_mm()
        inside = self._in_image(goal[None], points, site.settings.start_mm)[1][0]
        points = points[inside]
        if not len(points):
            raise InvalidArgument("goal must be a pose, in mm, whose image holds tissue of the scene", field="goal")
        self._points = points[np.linspace(0, len(points) - 1, min(self.POINTS, len(points))).astype(int)]
        self._seen = np.zeros((count, len(self._points)), np.bool_)

    def _in_image(self, poses: FloatArray, points: FloatArray, slice_mm: float) -> tuple[FloatArray, BoolArray]:
        """Columns of points in images, 0 to 1, and whether they lie in them: [K, P] both."""
        x, y, z = np.moveaxis(self.site.in_probe_frame(poses, points), -1, 0)
        rows, columns = self.site.probe.image_coordinates(x, z)
        return columns, ~np.isnan(rows) & ~np.isnan(columns) & (np.abs(y) <= slice_mm)

    def begin(self, which: BoolArray) -> None:
        self._seen[which] = False

    def judge(self, which: BoolArray, view: View) -> Judgement:
        columns, inside = self._in_image(view.poses, self._points, self.SLICE_MM)
        width = view.lines.shape[1]
        lines = np.clip(np.nan_to_num(columns) * width, 0, width - 1).astype(int)
        before = self._seen[which]
        seen = before | (inside & np.take_along_axis(view.lines, lines, axis=1))
        self._seen[which] = seen
        shares, gained = seen.mean(axis=1), (seen & ~before).mean(axis=1)
        return Judgement(
            _tensor(100.0 * gained, view.frames) + _contact_of(view), shares >= self.COVERED, {"covered_share": shares}
        )


@dataclass(frozen=True, eq=False)
class Centreline:
    """The middle of a structure, from one end to the other."""

    points: FloatArray  # [P, 3] mm
    along_mm: FloatArray  # [P], from the first
    STEP_MM: ClassVar[float] = 1.0

    @classmethod
    def of(cls, points: FloatArray, towards: FloatArray) -> Centreline:  # [N, 3], [3]
        """Means of the points in slices of STEP_MM across their longest extent, which runs `towards` a direction."""
        middle = points.mean(axis=0)
        axis = np.linalg.svd(points - middle, full_matrices=False)[2][0]
        axis *= 1.0 if axis @ towards >= 0.0 else -1.0
        slices = np.floor((points - middle) @ axis / cls.STEP_MM).astype(int)
        means = np.stack([points[slices == one].mean(axis=0) for one in np.unique(slices)])
        steps = np.linalg.norm(np.diff(means, axis=0), axis=1)
        return cls(means, np.concatenate([[0.0], steps.cumsum()]))


class Vessel(Task):
    """Follow the structure `label` to where the image of the goal crosses it, and keep it in the middle of the image.

    Reward: the way along it that is new, in `step_mm`, − its distance from the middle of the image, in halves of the
    image's breadth, + (share of contact − 1). Done within `reached_mm` of the end of the way.
    """

    name = TaskName.VESSEL
    POSTS = 64

    def __init__(self, site: Site, goal: FloatArray, count: int) -> None:
        super().__init__(site, goal, count)
        views = site.scene.training_poses
        if not len(views):
            raise InvalidArgument(
                "a vessel is followed along the sweep, and the scene holds no training poses", field="scene"
            )
        far = int(site.between(views, self.posts)[0][:, 0].argmax())
        self._line = Centreline.of(site.points_mm(site.settings.label), goal[:3, 3] - views[far, :3, 3])
        chosen = views[np.linspace(0, len(views) - 1, min(self.POSTS, len(views))).astype(int)]
        self.posts = np.concatenate([views[far][None], chosen, goal[None]])
        self._end_mm = float(self._places(goal[None])[0][0])
        self._begun_mm = float(self._places(views[far][None])[0][0])
        self._best_mm = np.full(count, self._begun_mm)

    def _places(self, poses: FloatArray) -> tuple[FloatArray, FloatArray]:  # [K, 4, 4] -> [K] both
        """How far along the structure images cross it, mm, and how far from their middles, in halves of the breadth."""
        places = self.site.in_probe_frame(poses, self._line.points)
        nearest = np.abs(places[..., 1]).argmin(axis=1)
        crossed = places[np.arange(len(poses)), nearest]
        lines = self.site.probe.lines
        _, across = lines.coordinates(crossed[:, 0], crossed[:, 2])
        offsets = np.abs(2.0 * (across - lines.start) / lines.span - 1.0)
        return self._line.along_mm[nearest], np.minimum(offsets, 1.0)

    def begin(self, which: BoolArray) -> None:
        self._best_mm[which] = np.nan

    def judge(self, which: BoolArray, view: View) -> Judgement:
        along_mm, offsets = self._places(view.poses)
        along_mm = np.where(offsets < 1.0, along_mm, -np.inf)  # out of sight it is not followed
        best = self._best_mm[which]
        best = np.where(np.isnan(best), np.maximum(along_mm, self._begun_mm), best)
        gained = np.maximum(along_mm - best, 0.0) / self.site.settings.step_mm
        self._best_mm[which] = np.maximum(best, along_mm)
        left_mm = np.maximum(self._end_mm - self._best_mm[which], 0.0)
        return Judgement(
            _tensor(gained - offsets, view.frames) + _contact_of(view),
            left_mm <= self.site.settings.reached_mm,
            {"left_mm": left_mm, "offset": offsets},
        )


class NeedleReach(Task):
    """Reach the structure `label`, where the image of the goal crosses it, with a needle in a guide on the probe.

    The guide is in the image plane, at the first scan line's face; at the goal it points to the middle of the
    structure. A seventh number of an action pushes the needle, in `step_mm`. Reward: what the tip came nearer, in
    `step_mm`, + (share of contact − 1). Done with the tip within `reached_mm`.
    """

    name = TaskName.NEEDLE
    action_size = 7
    OUTSIDE_MM = 60.0  # of the needle, before it is pushed

    def __init__(self, site: Site, goal: FloatArray, count: int) -> None:
        super().__init__(site, goal, count)
        line = Centreline.of(site.points_mm(site.settings.label), goal[:3, 1])
        places = site.in_probe_frame(goal[None], line.points)[0]
        nearest = np.abs(places[:, 1]).argmin()
        self.target_mm = line.points[nearest]
        origins, directions = site.probe.scan_lines(site.settings.width)
        self._entry = (origins + site.probe.face_depth_mm * directions)[0]
        way = places[nearest] * [1.0, 0.0, 1.0] - self._entry
        self._along = way / np.linalg.norm(way)
        self._most_mm = 1.5 * float(np.linalg.norm(way))
        self._depths_mm, self._away_mm = np.zeros(count), np.full(count, np.nan)

    def begin(self, which: BoolArray) -> None:
        self._depths_mm[which], self._away_mm[which] = 0.0, np.nan

    def act(self, which: BoolArray, more: FloatArray) -> None:
        pushed = self._depths_mm[which] + self.site.settings.step_mm * more[which, 0]
        self._depths_mm[which] = np.clip(pushed, 0.0, self._most_mm)

    def tools(self, which: BoolArray) -> list[tuple[Tool, ...]]:
        hub = tuple((self._entry - self.OUTSIDE_MM * self._along).tolist())
        tips = self._entry + self._depths_mm[which, None] * self._along
        return [(Needle(tip_mm=tuple(tip), hub_mm=hub, frame=ToolFrame.PROBE),) for tip in tips.tolist()]

    def judge(self, which: BoolArray, view: View) -> Judgement:
        tips = self._entry + self._depths_mm[which, None] * self._along  # [K, 3] in the probe's frames
        targets = self.site.in_probe_frame(view.poses, self.target_mm[None])[:, 0]
        away_mm = np.linalg.norm(tips - targets, axis=1)
        before = np.where(np.isnan(self._away_mm[which]), away_mm, self._away_mm[which])
        self._away_mm[which] = away_mm
        nearer = _tensor((before - away_mm) / self.site.settings.step_mm, view.frames)
        infos = {"tip_mm": away_mm, "needle_mm": self._depths_mm[which].copy()}
        return Judgement(nearer + _contact_of(view), away_mm <= self.site.settings.reached_mm, infos)
