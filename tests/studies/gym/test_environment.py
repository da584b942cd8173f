"""The environment by gymnasium's own checker, what it shows and rewards, and its seeds."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from ultragray import ConvexProbe, LinearProbe, render
from ultragray.errors import InvalidArgument, InvalidPose, InvalidProbe
from ultragray.rendering.contact import Skin, Touch
from ultragray.rendering.pixels import to_uint8
from ultragray.rendering.settings import Contact
from ultragray_studies.gym import STANDARD_PLANE, UltragrayEnv
from ultragray_studies.gym.scan import moved

LINEAR = LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=40.0)
CONVEX = ConvexProbe(opening_angle_deg=50.0, near_mm=20.0, far_mm=60.0)
SMALL = {"height": 24, "width": 20, "start_mm": 4.0, "start_deg": 5.0}
FAR_AWAY = np.eye(4)
FAR_AWAY[1, 3] = 5000.0


@pytest.fixture(scope="module", params=[LINEAR, CONVEX], ids=["linear", "convex"])
def scene(request, random_scene):
    probe = request.param
    views = np.stack([np.eye(4)] * 9)
    views[:, 1, 3] = np.linspace(-8.0, 8.0, 9)
    views[:, 2, 3] = -probe.face_depth_mm
    return replace(random_scene(400, info={"probe": probe}), training_poses=views)


@pytest.fixture
def env(scene):
    return UltragrayEnv(scene, **SMALL)


@pytest.mark.parametrize("with_pose", [False, True])
@pytest.mark.parametrize("contact", [None, *Contact])
def test_gymnasiums_checker_is_content(scene, with_pose, contact):
    """And warns of nothing: warnings are errors here."""
    made = gymnasium.make(
        STANDARD_PLANE, scene=scene, render_mode="rgb_array", with_pose=with_pose, contact=contact, **SMALL
    )
    check_env(made.unwrapped)


def test_it_is_made_by_name_from_a_file(scene, tmp_path):
    scene.save(tmp_path / "scene.ugr")
    made = gymnasium.make(STANDARD_PLANE, scene=tmp_path / "scene.ugr", goal=2, contact="air", **SMALL)
    unwrapped = made.unwrapped
    np.testing.assert_array_equal(unwrapped.goal, scene.training_poses[2])
    observation, _ = made.reset(seed=1)
    assert observation.shape == (24, 20, 1)
    ends = [made.step(np.zeros(6, np.float32))[3] for _ in range(200)]
    assert ends == [False] * 199 + [True]


def test_the_same_seed_is_the_same_episode(scene):
    def episode(seed):
        made = UltragrayEnv(scene, **SMALL)
        made.action_space.seed(seed)
        frames, rewards = [made.reset(seed=seed)[0]], []
        for _ in range(5):
            frame, reward, *_ = made.step(made.action_space.sample())
            frames.append(frame)
            rewards.append(reward)
        return frames, rewards

    frames, rewards = episode(3)
    again, rewards_again = episode(3)
    assert all(np.array_equal(one, other) for one, other in zip(frames, again, strict=True))
    assert rewards == rewards_again
    assert not np.array_equal(frames[0], episode(4)[0][0])


def test_starts_lie_around_the_goal_and_touch_the_skin(env, scene):
    skin, probe = Skin.under(scene.training_poses, scene.info.probe), scene.info.probe_or(None)
    infos = [env.reset(seed=seed)[1] for seed in range(40)]
    assert max(info["distance_mm"] for info in infos) <= 4.0 + 1e-9
    assert max(info["angle_deg"] for info in infos) <= 5.0 + 1e-9
    assert max(info["distance_mm"] for info in infos) > 2.5
    assert max(info["angle_deg"] for info in infos) > 3.0
    for info in infos:
        assert info["contact_share"] == Touch.of(skin, probe, info["pose"], 20).shares[0] >= 0.5


def test_the_frame_is_the_librarys(env, scene):
    frame, info = env.reset(seed=0)
    expected = render(scene, None, info["pose"], height=24, width=20, outputs=("bmode",), contact=Contact.AIR)
    np.testing.assert_array_equal(frame[..., 0], to_uint8(expected["bmode"][0].numpy()))


def one_moved(pose, shift_mm, turn_deg=(0.0, 0.0, 0.0), pivot_mm=0.0):
    return moved(pose[None], np.array([shift_mm]), np.array([turn_deg]), pivot_mm)[0]


def test_an_action_moves_the_face_in_the_probes_frame(scene):
    env = UltragrayEnv(scene, step_mm=2.0, step_deg=3.0, **SMALL)
    pivot = scene.info.probe_or(None).pivot_depth_mm
    _, info = env.reset(seed=5)
    before = info["pose"]
    action = np.array([0.5, -0.25, 0.125, 0.75, -0.5, 0.25])  # in steps of 2 mm and 3°
    after = env.step(action)[4]["pose"]
    faces = [pose @ np.array([0.0, 0.0, pivot, 1.0]) for pose in (before, after)]
    np.testing.assert_allclose(before[:3, :3].T @ (faces[1] - faces[0])[:3], [1.0, -0.5, 0.25], atol=1e-9)
    turn = before[:3, :3].T @ after[:3, :3]
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) == pytest.approx(3.0 * np.linalg.norm(action[3:]), abs=1e-6)
    np.testing.assert_allclose(after, one_moved(before, 2.0 * action[:3], 3.0 * action[3:], pivot), atol=1e-9)
    env.reset(options={"pose": before})
    clipped = env.step(np.array([50.0, 0, 0, 0, 0, 0]))[4]["pose"]
    np.testing.assert_allclose(before[:3, :3].T @ (clipped - before)[:3, 3], [2.0, 0.0, 0.0], atol=1e-6)


def test_the_goal_is_the_best_place_and_ends_the_episode(env):
    away = one_moved(env.goal, [0.0, 3.0, 0.0])
    _, info = env.reset(options={"pose": away})
    assert info["distance_mm"] == pytest.approx(3.0)
    rewards, ends = [], []
    for _ in range(2):
        _, reward, terminated, truncated, info = env.step(np.array([0.0, -0.75, 0.0, 0.0, 0.0, 0.0]))
        rewards.append(reward)
        ends.append(terminated)
        assert not truncated
    assert rewards[0] < rewards[1] <= 0.0
    assert rewards[1] == pytest.approx(0.0, abs=1e-5)
    assert info["similarity"] == pytest.approx(1.0)
    assert ends == [False, True]


def test_the_goal_is_not_reached_in_the_air(scene):
    env = UltragrayEnv(scene, reached_mm=5.0, **SMALL)
    still = np.zeros(6)
    env.reset(options={"pose": one_moved(env.goal, [0.0, 0.0, -3.0])})
    assert not env.step(still)[2]
    env.reset(options={"pose": one_moved(env.goal, [0.0, 0.0, 3.0])})
    assert env.step(still)[2]


def test_the_probe_stays_around_the_goal(env):
    env.reset(seed=0)
    for _ in range(40):
        info = env.step(np.array([0.0, 2.0, 0.0, 0.0, 0.0, 0.0]))[4]
    assert 2 * 4.0 + 10.0 - 2.0 < info["distance_mm"] <= 2 * 4.0 + 10.0


def test_the_pose_is_told_from_the_start_on(scene):
    made = UltragrayEnv(scene, with_pose=True, **SMALL)
    observation, info = made.reset(seed=2)
    np.testing.assert_allclose(observation["pose"], [0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1], atol=1e-6)
    start = info["pose"]
    observation, _, _, _, info = made.step(made.action_space.sample())
    relative = np.linalg.inv(start) @ info["pose"]
    np.testing.assert_allclose(observation["pose"][:3], relative[:3, 3], atol=1e-5)
    np.testing.assert_allclose(observation["pose"][3:].reshape(3, 3), relative[:3, :3], atol=1e-5)


def test_pictures_show_frame_and_goal(scene):
    made = UltragrayEnv(scene, render_mode="rgb_array", **SMALL)
    frame, _ = made.reset(seed=0)
    picture = made.render()
    assert picture.shape == (24, 40, 3)
    np.testing.assert_array_equal(picture[:, :20, 1], frame[..., 0])
    made.reset(options={"pose": made.goal})
    again = made.render()
    np.testing.assert_array_equal(again[:, :20], again[:, 20:])
    assert UltragrayEnv(scene, **SMALL).render() is None


def test_a_scene_without_skin_is_scanned_with_assumed_contact(random_scene):
    bare = random_scene(50, info={"probe": LINEAR})
    with pytest.raises(InvalidArgument, match="contact needs a scene"):
        UltragrayEnv(bare, np.eye(4), **SMALL).reset(seed=0)
    _, info = UltragrayEnv(bare, np.eye(4), contact=None, **SMALL).reset(seed=0)
    assert info["contact_share"] == 1.0


@pytest.mark.parametrize(
    ("given", "error", "match"),
    [
        ({"goal": 9}, InvalidArgument, "0 to 8, got 9"),
        ({"goal": np.eye(3)}, InvalidPose, "goal must have shape"),
        ({"goal": FAR_AWAY}, InvalidArgument, "goal must be a pose, in mm, from which the scene shows something"),
        ({"probe": {"kind": "linear"}}, InvalidProbe, "probe must be a Probe, such as LinearProbe"),
        ({"render_mode": "human"}, InvalidArgument, "render_mode must be rgb_array or None, got 'human'"),
        ({"contact": "gel"}, InvalidArgument, "contact must be one of air, pressure, got 'gel'"),
        ({"colour": True}, TypeError, "colour"),
    ],
)
def test_mistakes_are_told(scene, given, error, match):
    with pytest.raises(error, match=match):
        UltragrayEnv(scene, **{**SMALL, **given})


def test_an_action_must_be_six_numbers(env):
    env.reset(seed=0)
    for action in (np.zeros(5), np.full(6, np.nan), "up", ["a"] * 6, [[0, 0, 0], [0, 0]], None):
        with pytest.raises(InvalidArgument, match="finite numbers from -1 to 1"):
            env.step(action)


def test_a_start_must_be_one_from_which_the_goal_can_be_reached(env):
    with pytest.raises(
        InvalidArgument, match=r"options\.pose must be within 18 mm and 20° of the goal, got 5000\.0 mm"
    ):
        env.reset(options={"pose": FAR_AWAY})
    with pytest.raises(InvalidPose, match=r"options\.pose must hold real numbers"):
        env.reset(options={"pose": "here"})
    with pytest.raises(InvalidArgument, match="options may hold pose and reset_mask, got poes"):
        env.reset(options={"poes": env.goal})
