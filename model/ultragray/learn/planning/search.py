"""Views that teach a scene most: chosen greedily from those in reach, then put in an order to travel.

In reading order: what counts (`Targets`), what a view is worth there (`Worth`), the choice, the way, `plan_views`.

The gain. Points v of what is wanted are looked at, each from a direction of the reach. A view p is worth to it

    w(v, p) = T(v, p) · φ(d, α)

T is the transmittance of the scene between the face and v (its own attenuation, integrated along the scan line: what
lies in shadow is not seen), d the distance of v to the image, α the angle between the view and the direction, and φ
falls with both: ½^(d / within_mm) for coverage; the logistic curve that the scene's confidence was
fitted to; or the terms of its uncertainty that shrink near views. The best view of a point counts:

    F(S) = mean over v of max over p in S ∪ (views that the scene has) of w(v, p)

F is monotone, and submodular: the more views there are, the less another one adds, whatever w ≥ 0 is (it is a facility
location). So taking the view with the largest gain, again and again, comes to at least 1 − 1/e of what the best choice
of as many views gains (Nemhauser, Wolsey and Fisher 1978), and gains that were computed before are upper bounds now: a
view whose bound is below a gain that is known need not be looked at (Minoux 1978). T ≤ 1 makes the gain without shadow
such a bound, so that shadows are computed for few of the views. What was best first need not be so beside the others:
so each view is then exchanged for one that gains more in its place, until there is none. With a limit on the way, views
are taken by gain per mm of detour, as long as one is within reach of it; for that choice there is no guarantee, and no
exchange.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from operator import itemgetter
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ultragray.errors import InvalidArgument
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.geometry.rotations import rotation_angles_deg
from ultragray.learn.planning.reach import evenly_spread, poses_in_reach, within_box
from ultragray.learn.planning.settings import MAX_LISTED, PlanSettings, ViewPlan, box_of
from ultragray.learn.sweep import IntArray, corner_distances_mm, spread_places
from ultragray.rendering.derived import BEYOND_MM, GAPS_MM
from ultragray.rendering.limits import UNLIMITED, Limits
from ultragray.rendering.volume_fields import sample_volume
from ultragray.rendering.volumes import VolumeGrid
from ultragray.scene.confidence import (
    ANGLE_DEG,
    DISTANCE_MM,
    FAR_MM,
    NEAR_MM,
    VARIANCE_TERMS,
    ConfidenceModel,
    logistic,
    read_model,
)
from ultragray.scene.gaussians import GaussianScene

# What counts: points in space, and of the scene's maps what is needed to choose and to see them.

POINTS = 2048
VOXELS = 20_000  # of a map
_TRIED = 32  # points for each that may count
MOST_RECORDED = 512  # views that the scene has; of more, evenly taken


class Map:
    """A field of a scene on voxels over a box, looked up at points."""

    def __init__(self, scene: GaussianScene, field: str, low: FloatArray, high: FloatArray) -> None:
        spacing_mm = float(np.cbrt(np.prod(high - low) / VOXELS))
        self.grid = VolumeGrid.over_box(low.tolist(), high.tolist(), spacing_mm)
        self._values = np.concatenate(list(sample_volume(scene, field, self.grid)))  # [z, y, x]

    def at(self, points: FloatArray) -> np.ndarray[Any, Any]:  # [..., 3] mm -> [...]
        """Those of the nearest voxels; 0 outside."""
        x, y, z = np.moveaxis(np.rint((points - self.grid.origin_mm) / self.grid.spacing_mm).astype(np.intp), -1, 0)
        depth, rows, columns = self._values.shape
        inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows) & (z >= 0) & (z < depth)
        values: np.ndarray[Any, Any] = self._values[
            np.where(inside, z, 0), np.where(inside, y, 0), np.where(inside, x, 0)
        ]
        return np.where(inside, values, 0)


@dataclass(frozen=True, eq=False)
class Targets:
    """Points that count, and for each the pose in reach whose direction it is looked at from."""

    points: FloatArray  # [V, 3] mm
    directions: IntArray  # [V], of the candidates

    @classmethod
    def of(
        cls,
        scene: GaussianScene,
        settings: PlanSettings,
        view: FloatArray | None,  # [4, 4]
        plane: FloatArray | None,  # [4]
        candidates: FloatArray,  # [C, 4, 4]
        probe: Probe,
    ) -> Targets:
        """Points of the image of a view, else of a plane, a box or a label, else of the images of the candidates.

        Raises InvalidArgument where none are left, and for a label of a scene that has none.
        """
        low, high = np.array(scene.info.bounds_min_mm), np.array(scene.info.bounds_max_mm)
        if settings.region_mm is not None:
            low, high = box_of(settings.region_mm, "region_mm")
        spread = evenly_spread(POINTS, 3)
        directions = (spread[:, 2] * len(candidates)).astype(np.int64)
        anywhere = settings.region_mm is None and settings.label is None and plane is None
        if view is not None or anywhere:
            whose = candidates[directions] if view is None else view[None]
            inside = probe.points_mm(spread[:, 0], spread[:, 1])
            points = (whose[:, :3, :3] @ inside[:, :, None])[..., 0] + whose[:, :3, 3]
        else:
            spread = evenly_spread(_TRIED * POINTS, 3)
            points = low + spread * (high - low)
        if plane is not None and view is None:
            points = points - (points @ plane[:3] - plane[3])[:, None] * plane[:3]
        counts = np.ones(len(points), bool)
        if settings.region_mm is not None or plane is not None:
            counts &= ((points >= low) & (points <= high)).all(axis=1)
        if settings.label is not None:
            if scene.labels is None:
                raise InvalidArgument(
                    "label is for scenes whose Gaussians carry labels, these carry none", field="label"
                )
            counts &= Map(scene, "labels", low, high).at(points) == settings.label
        chosen = np.flatnonzero(counts)
        if not len(chosen):
            names = [name for name in ("label", "plane", "region_mm") if getattr(settings, name) is not None]
            raise InvalidArgument(
                f"nothing of the scene has {' and '.join(names)} as asked for: no point is left that counts",
                field=names[0],
            )
        chosen = chosen[spread_places(len(chosen), POINTS)]
        return cls(points[chosen], directions[chosen % POINTS])


# What a view is worth at each point: φ from where the point lies to the image, T from the map of attenuation.

Values: TypeAlias = npt.NDArray[np.floating[Any]]
Curve: TypeAlias = Callable[[Values, Values], Any]  # mm and degrees [C, V] -> [C, V] in [0, 1]
_AT_ONCE = 32  # poses
_STEPS = 8  # of the integral along a scan line
_NEGLIGIBLE = 1e-3  # more than a point has already, or shadows are not looked for


def distances_mm(poses: FloatArray, probe: Probe, points: FloatArray) -> Values:  # [C, 4, 4], [V, 3] -> [C, V]
    """Of points to the images of poses."""
    turned = poses[:, :3, :3].transpose(0, 2, 1).astype(np.float32)
    offsets = turned @ points.T.astype(np.float32) - (turned @ poses[:, :3, 3:].astype(np.float32))
    x, y, z = offsets.transpose(1, 0, 2)
    edges = probe.lines.edges
    aside = edges.scale * np.abs(x - edges.slope * z) - edges.across * z - edges.half
    depth = np.hypot(x, z) if edges.fanned else edges.by_z * z
    beyond = np.maximum(probe.near_mm - depth, depth - probe.far_mm)
    distances: Values = np.sqrt(y * y + np.maximum(aside, 0.0) ** 2 + np.maximum(beyond, 0.0) ** 2)
    return distances


def curve_of(settings: PlanSettings, model: ConfidenceModel | None, hardness: Values) -> Curve:  # [V]
    """φ for what is wanted. Of confidence the distance between views is taken as if they were on one side.

    Raises InvalidArgument where the scene does not have the model that is needed.
    """
    match settings.want:
        case "coverage":
            return lambda distance, _: np.exp2(-distance / settings.within_mm)
        case "confidence" if model is not None:
            return partial(_expected, model.weights, hardness)
        case "uncertainty" if model is not None and model.uncertainty is not None:
            shares = dict(zip(VARIANCE_TERMS, model.uncertainty.variances, strict=True))
            reaches = [(shares[f"gap {reach:g} mm"], reach) for reach in GAPS_MM] + [(shares["beyond"], BEYOND_MM)]
            if (total := sum(share for share, _ in reaches)) > 0.0:
                return lambda distance, _: sum(share * np.exp(-distance / reach) for share, reach in reaches) / total
    raise InvalidArgument(
        f"this scene tells no {settings.want}: want coverage, or train it with confidence", field="want"
    )


def _expected(weights: Sequence[float], hardness: Values, distance: Values, angle: Values) -> Any:
    """The logistic curve of `ultragray.scene.confidence`."""
    near = np.minimum(distance, FAR_MM)
    w = [np.float32(weight) for weight in weights]
    return logistic(
        w[0] - w[1] * np.log1p(near / NEAR_MM) - w[2] * near / DISTANCE_MM - w[3] * angle / ANGLE_DEG - w[4] * hardness
    )


def worth_without_shadow(
    curve: Curve, targets: Targets, candidates: FloatArray, poses: FloatArray, probe: Probe
) -> Values:  # [C, 4, 4], [P, 4, 4] -> [P, V]
    worth = np.empty((len(poses), len(targets.points)), np.float32)
    for first in range(0, len(poses), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        angles = rotation_angles_deg(poses[some], candidates).astype(np.float32)[:, targets.directions]
        worth[some] = curve(distances_mm(poses[some], probe, targets.points), angles)
    return worth


def shade(
    worth: Values, best: Values, points: FloatArray, pose: FloatArray, probe: Probe, attenuation: Map
) -> None:  # [V], [V], [V, 3], [4, 4]
    """Puts its shadows into what a view is worth: exp(−∫ attenuation) along the scan lines from the face to points.

    Only where it would be better than the best.
    """
    which = np.flatnonzero(worth > best + _NEGLIGIBLE)
    local, face_mm = (points[which] - pose[:3, 3]) @ pose[:3, :3], probe.face_depth_mm
    depth, across = probe.lines.coordinates(local[:, 0], local[:, 2])
    across = np.clip(across, probe.lines.start, probe.lines.start + probe.lines.span)
    lengths = np.clip(np.nan_to_num(depth), face_mm, probe.far_mm) - face_mm
    origins, directions = probe.lines.rays(across)
    depths = face_mm + lengths * ((np.arange(_STEPS)[:, None] + 0.5) / _STEPS)  # [S, K]
    lines = origins + depths[..., None] * directions  # [S, K, 2]
    path = pose[:3, 3] + lines[..., :1] * pose[:3, 0] + lines[..., 1:] * pose[:3, 2]
    worth[which] *= np.exp(-attenuation.at(path).mean(axis=0) * lengths)


# The choice.

LEAST_GAIN = 1e-6
_LEAST_DETOUR_MM = 1.0


def choose(
    worth: Values,  # [C, V], what the views are worth without shadow; what is looked at is shaded in place
    best: Values,  # [V], of the views before; raised
    views: int,
    *,
    shade: Callable[[int], None] = lambda view: None,
    costs: FloatArray | None = None,  # [C], by which gains are divided; infinite: it cannot be had
    after_each: Callable[[int], None] = lambda view: None,
) -> tuple[list[int], list[float]]:
    """The views with the largest gains in turn, and these gains, until none that can be had gains anything."""
    costs = np.ones(len(worth)) if costs is None else costs
    bounds = (np.maximum(worth, best).mean(axis=1) - best.mean()).astype(np.float64)
    is_shaded = np.zeros(len(worth), bool)
    chosen: list[int] = []
    gains: list[float] = []
    while len(chosen) < views:
        is_known = np.zeros(len(worth), bool)
        while not is_known[view := int((bounds / costs).argmax())]:
            if not is_shaded[view]:
                shade(view)
                is_shaded[view] = True
            gain = np.maximum(worth[view] - best, 0.0).mean(dtype=np.float64)
            bounds[view] = gain if gain >= LEAST_GAIN else 0.0  # for good: the more views, the less one adds
            is_known[view] = True
        if not bounds[view] or math.isinf(costs[view]):
            break
        chosen.append(view)
        gains.append(float(bounds[view]))
        np.maximum(best, worth[view], out=best)
        bounds[view] = 0.0
        after_each(view)
    return chosen, gains


_ROUNDS = 4  # of exchanges, at most
_LEAST_MORE = 1e-3  # that another view must gain in the place of one, as a share of its gain


def exchange(worth: Values, before: Values, chosen: Sequence[int], *, shade: Callable[[int], None]) -> list[int]:
    """The chosen views, each exchanged for the one that gains most in its place, in turn, until none would gain more.

    `worth` [C, V] is as `choose` has it, `before` [V] what points had without any of them.
    """
    views = list(chosen)
    for _ in range(_ROUNDS):
        is_changed = False
        for place, view in enumerate(views):
            others = np.maximum.reduce([before, *worth[views[:place] + views[place + 1 :]]])
            gain = np.maximum(worth[view] - others, 0.0).mean(dtype=np.float64)
            better, gains = choose(worth, others, 1, shade=shade)
            if better and gains[0] > (1.0 + _LEAST_MORE) * gain:
                views[place], is_changed = better[0], True
        if not is_changed:
            break
    return views


# The way: the shortest path through views whose order is free. Steps are taken as symmetric, and the path may end
# anywhere.
#
# By 2-opt (Croes 1958): parts of the path are turned round as long as that shortens it, from paths that begin at
# several views and go on to the nearest one. That is our own, as the approximations of networkx leave paths of 50
# views 10 to 20% longer, and the other kept solvers bring more packages or tens of megabytes.

_STARTS = 8


def shortest_path(steps_mm: FloatArray, from_start_mm: FloatArray | None) -> tuple[IntArray, float]:  # [K, K], [K]
    """An order of views that is short to travel, and the length of the way, from a start where one is given."""
    if not len(steps_mm):
        return np.zeros(0, np.int64), 0.0
    ways, firsts = _with_ends(steps_mm, from_start_mm), spread_places(len(steps_mm), _STARTS)
    paths = [_improved(ways, _nearest_next(steps_mm, int(first))) for first in firsts]
    order, length_mm = min(paths, key=itemgetter(1))
    return order, length_mm


def _with_ends(steps_mm: FloatArray, from_start_mm: FloatArray | None) -> FloatArray:  # [K, K], [K] -> [K + 2, K + 2]
    """The steps between views, and behind these the start, which may be anywhere, and the end, which is."""
    ways = np.pad(steps_mm, (0, 2))
    if from_start_mm is not None:
        ways[-2, :-2] = ways[:-2, -2] = from_start_mm
    return ways


def _nearest_next(steps_mm: FloatArray, first: int) -> IntArray:  # [K, K] -> [K]
    order = [first]
    unvisited = np.ones(len(steps_mm), bool)
    for _ in range(len(steps_mm) - 1):
        unvisited[order[-1]] = False
        order.append(int(np.where(unvisited, steps_mm[order[-1]], np.inf).argmin()))
    return np.array(order, np.int64)


def _improved(ways: FloatArray, order: IntArray) -> tuple[IntArray, float]:  # [K + 2, K + 2], [K]
    start, end = len(order), len(order) + 1
    first, last = np.triu_indices(len(order))  # of the part that is turned round
    while True:
        path = np.concatenate([[start], order, [end]])
        steps = ways[path[:-1], path[1:]]
        turned = ways[path[first], path[last + 1]] + ways[path[first + 1], path[last + 2]]
        longer = turned - steps[first] - steps[last + 1]
        best = int(longer.argmin())
        if longer[best] > -1e-9:
            return order, float(steps.sum())
        part = slice(first[best], last[best] + 1)
        order = np.concatenate([order[: part.start], order[part][::-1], order[part.stop :]])


class Way:
    """A way of at most `most_mm` through views that are added one by one, each where that makes it least longer."""

    def __init__(self, corners: FloatArray, from_start_mm: FloatArray | None, most_mm: float) -> None:
        """Among C candidates, by the corners of their images [C, K, 3] mm, from a start where one is given."""
        self.views: list[int] = []  # in the order to travel
        self.length_mm = 0.0
        self.costs = np.zeros(len(corners))  # mm of each candidate's detour; infinite where it would be too long
        self._corners, self._most_mm = corners, most_mm
        self._from_start_mm = np.zeros(len(corners)) if from_start_mm is None else from_start_mm
        self._to_views_mm = np.zeros((len(corners), 0))  # [C, K], these in their order
        self._look()

    def add(self, view: int) -> None:
        place = int(self._detours_mm[view].argmin())
        views = [*self.views[:place], view, *self.views[place:]]
        to_view_mm = corner_distances_mm(self._corners, self._corners[view])
        to_views_mm = np.insert(self._to_views_mm, place, to_view_mm, axis=1)
        ways = _with_ends(to_views_mm[views], self._from_start_mm[views])
        order, self.length_mm = _improved(ways, np.arange(len(views)))
        self.views, self._to_views_mm = [views[place] for place in order], to_views_mm[:, order]
        self._look()

    def _look(self) -> None:
        """Measures the detour to each candidate, at each place of the way [C, K + 1]."""
        stops = np.column_stack([self._from_start_mm, self._to_views_mm, np.zeros(len(self._corners))])  # [C, K + 2]
        first_step = self._from_start_mm[self.views[:1]]
        between = self._to_views_mm[self.views[:-1], np.arange(1, len(self.views))]
        steps = np.concatenate([first_step, between, np.zeros(1)])
        self._detours_mm = stops[:, :-1] + stops[:, 1:] - steps
        detours = np.maximum(self._detours_mm.min(axis=1), 0.0)
        self.costs[:] = np.where(self.length_mm + detours <= self._most_mm, detours + _LEAST_DETOUR_MM, np.inf)


def plan_views(
    scene: GaussianScene,
    settings: PlanSettings | None = None,
    *,
    poses: Any = None,
    view: Any = None,
    start: Any = None,
    limits: Limits = UNLIMITED,
) -> ViewPlan:
    """The poses in reach whose frames would teach a scene most, in an order to travel them; mm, probe→scene.

    `poses` [C, 4, 4] are all that is in reach, at most 4096 (None: what `settings` say of the skin); `view` [4, 4] is a
    standard plane: only the points of its image count; `start` [4, 4] is where the probe is (None: the way begins
    anywhere). Raises InvalidArgument, InvalidPose, InvalidProbe; GivenUp by `limits`.
    """
    settings = settings or PlanSettings()
    at_rest = scene.at_rest()
    probe, recorded = scene.info.probe_or(settings.probe), at_rest.training_poses

    standard, begin = _single(scene, view, "view"), _single(scene, start, "start")
    plane = _plane(settings, standard)
    if poses is None:
        candidates = poses_in_reach(recorded, scene.info.probe, probe, settings, plane)
    else:
        candidates = _listed(scene, poses, probe, settings)
    targets = Targets.of(at_rest, settings, standard, plane, candidates, probe)
    limits.check_flag()
    model, hardness = read_model(scene.info.confidence, len(recorded)), np.zeros(len(targets.points), np.float32)
    own, places = scene.info.probe_or(settings.probe), spread_places(len(recorded), MOST_RECORDED)
    recorded = recorded[places]
    if model is not None:  # of the recorded view that is nearest to each point
        hardness = np.array(model.hardness, np.float32)[places][
            distances_mm(recorded, own, targets.points).argmin(axis=0)
        ]
    attenuation = Map(at_rest, "attenuation", *map(np.array, (scene.info.bounds_min_mm, scene.info.bounds_max_mm)))
    worth_of = partial(worth_without_shadow, curve_of(settings, model, hardness), targets, candidates)
    best = np.zeros(len(targets.points), np.float32)
    for pose, worth in zip(recorded, worth_of(recorded, own), strict=True):
        shade(worth, best, targets.points, pose, own, attenuation)
        np.maximum(best, worth, out=best)
    limits.check_flag()
    before, worths = float(best.mean(dtype=np.float64)), worth_of(candidates, probe)
    corners = probe.corners_from(candidates)
    from_start = None if begin is None else corner_distances_mm(corners, probe.corners_from(begin[None]))
    is_shaded = np.zeros(len(candidates), bool)

    def shade_once(view: int) -> None:
        limits.check_flag()
        if not is_shaded[view]:
            shade(worths[view], best, targets.points, candidates[view], probe, attenuation)
        is_shaded[view] = True

    if settings.path_mm is None:
        chosen, gains = _exchanged(worths, best, settings.views, shade_once)
        steps_mm = corner_distances_mm(corners[chosen][:, None], corners[chosen][None])
        order, path_mm = shortest_path(steps_mm, None if from_start is None else from_start[chosen])
    else:
        way = Way(corners, from_start, settings.path_mm)
        chosen, gains = choose(
            worths, best.copy(), settings.views, shade=shade_once, costs=way.costs, after_each=way.add
        )
        order, path_mm = np.array([chosen.index(view) for view in way.views], np.int64), way.length_mm
    scale, least = 1.0, 0.0
    if settings.want == "confidence" and model is not None:
        scale, least = 1.0 - model.black_ms_ssim, model.black_ms_ssim
    return ViewPlan(
        poses=scene.poses_as_tracked(candidates[np.array(chosen, np.int64)[order]]),
        gains=scale * np.array(gains)[order],
        ranks=order,
        before=least + scale * before,
        after=least + scale * (before + sum(gains)),
        path_mm=path_mm,
    )


def _plane(settings: PlanSettings, standard: FloatArray | None) -> FloatArray | None:  # [4, 4] -> [4]
    """The normal and distance of the plane whose points count: that of the standard view, or the one in the settings.

    Raises InvalidArgument where both are given.
    """
    if standard is not None:
        if settings.plane is not None:
            raise InvalidArgument("view is a plane of its own: give view or plane, not both", field="plane")
        return np.append(standard[:3, 1], standard[:3, 1] @ standard[:3, 3])
    if settings.plane is None:
        return None
    normal = np.array(settings.plane[:3])
    return np.append(normal / np.linalg.norm(normal), settings.plane[3])


def _listed(scene: GaussianScene, poses: Any, probe: Probe, settings: PlanSettings) -> FloatArray:  # -> [C, 4, 4] mm
    """Poses that a caller lists as all in reach, in the tissue at rest, less those outside of box_mm.

    Raises InvalidArgument where there are too many or none is left, and InvalidPose.
    """
    listed = scene.poses_at_rest(check_poses(poses))
    if not 1 <= len(listed) <= MAX_LISTED:
        raise InvalidArgument(f"poses must be 1 to {MAX_LISTED}, got {len(listed)}", field="poses")
    candidates = listed[within_box(listed, probe, settings)]
    if not len(candidates):
        raise InvalidArgument("none of the poses has the middle of the probe's face within box_mm", field="box_mm")
    return candidates


def _exchanged(
    worths: Values, best: Values, views: int, shade: Callable[[int], None]
) -> tuple[list[int], list[float]]:  # [C, V], [V]
    """The views of the largest gains, exchanged, in the order of what each gains beside those before it."""
    chosen, _ = choose(worths, best.copy(), views, shade=shade)
    chosen = exchange(worths, best, chosen, shade=shade)
    ranks, gains = choose(worths[chosen], best, len(chosen))
    return [chosen[rank] for rank in ranks], gains


def _single(scene: GaussianScene, pose: Any, field: str) -> FloatArray | None:  # -> [4, 4] mm, at rest
    if pose is None:
        return None
    checked = check_poses(pose, field=field)
    if len(checked) != 1:
        raise InvalidArgument(f"{field} must be one pose, got {len(checked)}", field=field)
    rest: FloatArray = scene.poses_at_rest(checked)[0]
    return rest
