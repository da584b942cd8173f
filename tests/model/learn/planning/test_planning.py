"""Where to look next: the choice, the reach, the way, and plans of the demo scene."""

from __future__ import annotations

from itertools import pairwise, permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ultragray import LinearProbe, PlanSettings, plan_views
from ultragray.errors import InvalidArgument
from ultragray.geometry.rotations import rotation_angles_deg
from ultragray.learn.planning.reach import LEAST_CONTACT, poses_in_reach
from ultragray.learn.planning.search import Way, choose, distances_mm, exchange, shortest_path
from ultragray.learn.sweep import corner_distances_mm
from ultragray.phantom.demo import load_demo_scene
from ultragray.rendering.contact import Skin, Touch
from ultragray.rendering.limits import GivenUp, Limits

SCENE = load_demo_scene()
PROBE = SCENE.info.probe_or(None)
SMALL = {"views": 6, "within_mm": 0.5}


def drawn(seed: int, views: int = 12, points: int = 40) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    return random.random((views, points)).astype(np.float32) ** 3, 0.2 * random.random(points).astype(np.float32)


@pytest.mark.parametrize("seed", range(20))
def test_lazy_evaluation_chooses_as_looking_at_every_view_does(seed: int) -> None:
    worth, best = drawn(seed)
    chosen, gains = choose(worth.copy(), best.copy(), 6)
    for view, gain in zip(chosen, gains, strict=True):
        each = np.maximum(worth - best, 0.0).mean(axis=1)
        assert view == each.argmax()
        assert gain == pytest.approx(each.max(), rel=1e-5)
        best = np.maximum(best, worth[view])
    assert all(one >= other for one, other in pairwise(gains))


@pytest.mark.parametrize("seed", range(5))
def test_a_shadow_is_looked_for_only_where_it_may_decide(seed: int) -> None:
    """Shadows take from what views are worth: the choice is the greedy one of the shaded views."""
    worth, best = drawn(seed, views=60)
    worth *= np.linspace(0.1, 1.0, 60, dtype=np.float32)[:, None]
    share = np.random.default_rng(seed).uniform(0.8, 1.0, 60).astype(np.float32)
    bounds, seen = worth.copy(), list[int]()

    def shade(view: int) -> None:
        seen.append(view)
        bounds[view] *= share[view]

    chosen, gains = choose(bounds, best.copy(), 3, shade=shade)
    assert (chosen, gains) == choose(worth * share[:, None], best.copy(), 3)
    assert len(seen) == len(set(seen)) < 60


def test_a_greedy_choice_is_near_the_best_one() -> None:
    worth, _ = drawn(1, views=9)
    nothing = np.zeros(40, np.float32)
    _, gains = choose(worth.copy(), nothing.copy(), 3)
    best = max(np.maximum.reduce(worth[list(views)]).mean() for views in permutations(range(9), 3))
    assert (1.0 - 1.0 / np.e) * best <= sum(gains) <= best + 1e-6


def test_views_that_were_best_alone_are_exchanged_for_those_that_are_best_together() -> None:
    """On a line from 0 to 8 one view is best in the middle, two at the quarters."""
    line = np.linspace(0.0, 8.0, 81)
    worth = np.exp2(-np.square((np.arange(9.0)[:, None] - line) / 2.0)).astype(np.float32)
    nothing = np.zeros(81, np.float32)
    chosen, gains = choose(worth.copy(), nothing.copy(), 2)
    assert chosen[0] == 4
    better = exchange(worth.copy(), nothing, chosen, shade=lambda view: None)
    assert sorted(better) == [2, 6]
    assert np.maximum.reduce(worth[better]).mean() > sum(gains)


@pytest.mark.parametrize("seed", range(5))
def test_exchanges_never_lose_anything_nor_what_points_had_before(seed: int) -> None:
    worth, before = drawn(seed, views=40)
    kept = before.copy()
    chosen, gains = choose(worth.copy(), before.copy(), 5)
    better = exchange(worth.copy(), before, chosen, shade=lambda view: None)
    np.testing.assert_array_equal(before, kept)
    assert len(set(better)) == 5
    assert np.maximum.reduce([before, *worth[better]]).mean() - before.mean() >= sum(gains) - 1e-6


def test_views_that_gain_nothing_are_left_out() -> None:
    worth = np.zeros((5, 8), np.float32)
    worth[2] = 1.0
    chosen, gains = choose(worth, np.zeros(8, np.float32), 4)
    assert (chosen, gains) == ([2], [1.0])


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("has_start", [False, True])
def test_the_way_through_few_views_is_the_shortest_one(seed: int, has_start: bool) -> None:
    places = np.random.default_rng(seed).uniform(0.0, 50.0, (6, 3))
    steps = np.linalg.norm(places[:, None] - places, axis=-1)
    start = np.linalg.norm(places - 60.0, axis=1) if has_start else None

    def length(order: tuple[int, ...]) -> float:
        first = 0.0 if start is None else start[order[0]]
        return float(first + steps[list(order[:-1]), list(order[1:])].sum())

    order, length_mm = shortest_path(steps, start)
    assert length_mm == pytest.approx(length(tuple(order)))
    assert length_mm == pytest.approx(min(map(length, permutations(range(6)))))


@pytest.mark.parametrize("probe", [LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=40.0), PROBE])
def test_distances_to_an_image_are_those_to_its_nearest_pixel(probe: LinearProbe) -> None:
    random = np.random.default_rng(0)
    pose = SCENE.training_poses[70]
    points = pose[:3, 3] + random.uniform(-50.0, 80.0, (30, 3))
    rows, columns = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 1, 400), np.linspace(0, 1, 400)))
    pixels = probe.points_mm(rows, columns) @ pose[:3, :3].T + pose[:3, 3]
    nearest = np.array([np.linalg.norm(pixels - point, axis=1).min() for point in points])
    np.testing.assert_allclose(distances_mm(pose[None], probe, points)[0], nearest, atol=0.15)


@settings(max_examples=25, deadline=None)
@given(
    tilt=st.floats(0.0, 40.0),
    rock=st.floats(0.0, 3.0),
    turn=st.floats(0.0, 90.0),
    x=st.floats(-8.0, 4.0),
    y=st.floats(-30.0, 20.0),
)
def test_all_poses_in_reach_are_allowed(tilt: float, rock: float, turn: float, x: float, y: float) -> None:
    low, high = np.array([x, y, -5.0]), np.array([x + 6.0, y + 10.0, 5.0])
    box = ",".join(f"{a}:{b}" for a, b in zip(low, high, strict=True))
    asked = PlanSettings(tilt_deg=tilt, rock_deg=rock, turn_deg=turn, box_mm=box)
    plane = np.array([0.0, 1.0, 0.0, y + 5.0])
    poses = poses_in_reach(SCENE.training_poses, PROBE, PROBE, asked, plane)
    faces = poses[:, :3, 3]
    assert ((faces >= low) & (faces <= high)).all()
    touch = Touch.of(Skin.under(SCENE.training_poses, PROBE), PROBE, poses, 16)
    assert (touch.shares >= LEAST_CONTACT).all()
    # the phantom's skin is flat but for the hand that scanned it: its normal is z within some degrees
    assert np.degrees(np.arccos(np.clip(poses[:, 2, 2], -1.0, 1.0))).max() <= np.hypot(tilt, rock) + 4.0


def test_half_of_the_poses_in_reach_lie_in_a_plane_that_is_wanted() -> None:
    asked = PlanSettings(tilt_deg=20.0, rock_deg=5.0, turn_deg=5.0)
    plane = np.array([0.0, np.cos(0.1), np.sin(0.1), 4.0])
    poses = poses_in_reach(SCENE.training_poses, PROBE, PROBE, asked, plane)
    off = np.abs(PROBE.corners_from(poses) @ plane[:3] - plane[3]).max(axis=1)
    assert (off < 1e-3).mean() > 0.3


@pytest.mark.parametrize("want", ["coverage", "confidence", "uncertainty"])
def test_gains_fall_with_their_rank_and_add_up(want: str) -> None:
    plan = plan_views(SCENE, PlanSettings(want=want, **SMALL))
    by_rank = plan.gains[np.argsort(plan.ranks)]
    assert len(plan.poses) == 6
    assert sorted(plan.ranks) == list(range(6))
    assert (np.diff(by_rank) <= 1e-9).all()
    assert plan.after - plan.before == pytest.approx(plan.gains.sum(), rel=1e-6)
    assert 0.0 < plan.before < plan.after < 1.0


def test_a_view_that_the_scene_has_already_gains_nothing() -> None:
    new = SCENE.training_poses[45].copy()
    new[1, 3] += 14.0
    plan = plan_views(SCENE, PlanSettings(within_mm=0.1), poses=np.stack([SCENE.training_poses[45], new]))
    assert plan.ranks[0] == 0
    np.testing.assert_allclose(plan.poses[0], new, atol=1e-9)
    assert len(plan.poses) == 1 or plan.gains.min() < 0.05 * plan.gains.max()


def test_the_same_plan_comes_of_the_same_scene() -> None:
    one, other = (plan_views(SCENE, PlanSettings(**SMALL)) for _ in range(2))
    np.testing.assert_array_equal(one.poses, other.poses)


def test_the_way_is_as_long_as_it_may_be_and_begins_at_the_start() -> None:
    start = SCENE.training_poses[0]
    free = plan_views(SCENE, PlanSettings(**SMALL))
    plan = plan_views(SCENE, PlanSettings(**SMALL | {"path_mm": 50.0}), start=start)
    assert len(plan.poses) >= 2
    corners = PROBE.corners_from(np.concatenate([start[None], plan.poses]))
    way_mm = corner_distances_mm(corners[1:], corners[:-1]).sum()
    assert plan.path_mm == pytest.approx(way_mm)
    assert plan.path_mm <= 50.0 < free.path_mm


@pytest.mark.parametrize("path_mm", [10.0, 40.0, 120.0])
def test_views_too_far_for_the_way_do_not_keep_others_from_it(path_mm: float) -> None:
    """Among more poses a plan gains about as much at least as among those of them that lie near the start."""
    start = SCENE.training_poses[45]
    asked = PlanSettings(**SMALL | {"path_mm": path_mm, "views": 100})
    near = np.repeat(start[None], 21, axis=0)
    near[:, 0, 3] += np.linspace(-20.0, 20.0, 21)
    far = SCENE.training_poses[[0, 90]].copy()
    far[:, 0, 3] += 30.0
    among_near, among_all = (plan_views(SCENE, asked, poses=some, start=start) for some in (near, [*near, *far]))
    assert among_near.gains.sum() > 0.0
    assert among_all.gains.sum() > 0.8 * among_near.gains.sum()
    assert among_all.path_mm <= path_mm
    for plan in (among_near, among_all):
        corners = PROBE.corners_from(np.concatenate([start[None], plan.poses]))
        assert plan.path_mm == pytest.approx(corner_distances_mm(corners[1:], corners[:-1]).sum())
        assert plan.after - plan.before == pytest.approx(plan.gains.sum())
        assert sorted(plan.ranks) == list(range(len(plan.poses)))


def test_a_near_view_that_hardly_gains_does_not_keep_a_far_one_from_the_way() -> None:
    places = np.zeros((3, 4, 3))
    places[:, :, 0] = np.array([0.0, 0.01, 900.0])[:, None]
    worth = np.zeros((3, 1000), np.float32)
    worth[:2, :500], worth[1, 0], worth[0, 600], worth[2, 500] = 0.5, 0.6, 8.9e-4, 0.5
    way = Way(places, None, 2000.0)
    chosen, _ = choose(worth, np.zeros(1000, np.float32), 5, costs=way.costs, after_each=way.add)
    assert sorted(chosen) == sorted(way.views) == [1, 2]
    assert way.length_mm == pytest.approx(899.99)


def test_bone_is_looked_at_from_where_it_is_seen() -> None:
    """Behind bone nothing is to be seen from above: a view that looks past it gains more than one through it."""
    label = next(number for number, name in SCENE.info.label_names.items() if name == "bone")
    plan = plan_views(SCENE, PlanSettings(label=label, **SMALL))
    through = plan_views(SCENE, PlanSettings(region_mm="-12:12,-6:6,45:60", **SMALL))
    assert plan.gains.max() > 0.0
    assert through.after < 0.6  # of what lies behind a vertebra, however many views are taken


@pytest.mark.parametrize(
    ("asked", "more", "field"),
    [
        ({"label": 200}, {}, "label"),
        ({"region_mm": "0:1,0:1,900:901", "label": 1}, {}, "label"),
        ({"box_mm": "500:510,0:5,0:5"}, {}, "box_mm"),
        ({}, {"poses": np.tile(np.eye(4), (5000, 1, 1))}, "poses"),
        ({}, {"start": np.tile(np.eye(4), (2, 1, 1))}, "start"),
        ({}, {"view": np.zeros((4, 4))}, "view"),
        ({"plane": (0.0, 1.0, 0.0, 1.0)}, {"view": np.eye(4)}, "plane"),
        ({"box_mm": "500:510,0:5,0:5"}, {"poses": np.eye(4)[None]}, "box_mm"),
    ],
)
def test_what_cannot_be_planned_is_told_by_its_field(asked: dict, more: dict, field: str) -> None:
    with pytest.raises(InvalidArgument) as error:
        plan_views(SCENE, PlanSettings(**asked), **more)
    assert error.value.field.startswith(field)


@pytest.mark.parametrize(
    ("wrong", "field"),
    [
        ({"want": "all"}, "want"),
        ({"region_mm": "1:2"}, "region_mm"),
        ({"box_mm": "2:1,0:1,0:1"}, "box_mm"),
        ({"plane": (0.0, 0.0, 0.0, 1.0)}, "plane"),
        ({"views": 0}, "views"),
    ],
)
def test_wrong_settings_are_told_by_their_field(wrong: dict, field: str) -> None:
    with pytest.raises(InvalidArgument) as error:
        PlanSettings(**wrong)
    assert error.value.field == field


def test_a_scene_without_its_model_says_what_it_can_tell() -> None:
    from dataclasses import replace

    plain = replace(SCENE, info=replace(SCENE.info, confidence={}))
    with pytest.raises(InvalidArgument, match="want coverage"):
        plan_views(plain, PlanSettings(want="confidence", **SMALL))
    assert len(plan_views(plain, PlanSettings(**SMALL)).poses) == 6


def test_a_plan_that_nobody_waits_for_ends() -> None:
    with pytest.raises(GivenUp):
        plan_views(SCENE, limits=Limits(flag=np.array([1]), number=1))


def test_a_standard_plane_is_looked_at_along_it() -> None:
    view = SCENE.training_poses[30].copy()
    view[:3, 3] += 6.0 * view[:3, 1]
    for plan in (
        plan_views(SCENE, PlanSettings(views=2, within_mm=0.3, tilt_deg=30.0, rock_deg=5.0, turn_deg=15.0), view=view),
        plan_views(
            SCENE,
            PlanSettings(
                views=2,
                within_mm=0.3,
                tilt_deg=30.0,
                rock_deg=5.0,
                turn_deg=15.0,
                plane=(*view[:3, 1], float(view[:3, 1] @ view[:3, 3])),
            ),
        ),
    ):
        first = plan.poses[plan.ranks == 0][0]
        assert np.abs(first[:3, 1] @ view[:3, 1]) > np.cos(np.radians(2.0))
        assert rotation_angles_deg(first[None], view[None])[0, 0] < 40.0
