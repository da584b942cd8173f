"""Many environments at once: as many single ones, in every way of beginning again; tensors; tasks; confidence."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from ultragray import LinearProbe
from ultragray.errors import InvalidArgument
from ultragray.phantom.demo import load_demo_scene
from ultragray.rendering.tools import Needle
from ultragray.scene.confidence import Assessor
from ultragray_studies.gym import ENVIRONMENTS, STANDARD_PLANE, TaskName, UltragrayEnv, UltragrayVectorEnv
from ultragray_studies.gym.scan import ScanSettings, moved

PROBE = LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=40.0)
SMALL = {"height": 24, "width": 20, "start_mm": 4.0, "start_deg": 5.0}
COUNT = 5


@pytest.fixture(scope="module")
def scene(random_scene):
    views = np.stack([np.eye(4)] * 9)
    views[:, 1, 3] = np.linspace(-8.0, 8.0, 9)
    return replace(random_scene(400, info={"probe": PROBE}), training_poses=views)


@pytest.fixture(scope="module")
def demo():
    """The demo scene: it knows a vessel, and its confidence."""
    return load_demo_scene()


@pytest.mark.parametrize("mode", AutoresetMode)
def test_many_are_as_many_single_ones(scene, mode):
    """By gymnasium's own way to make many of one: the same seeds and actions give the same in all that is returned."""
    limits = {"max_episode_steps": 4, "reached_mm": 3.0, "reached_deg": 4.0, "goal": 3, "with_pose": True, **SMALL}
    made = gymnasium.make_vec(STANDARD_PLANE, num_envs=COUNT, scene=scene, autoreset_mode=mode, as_numpy=True, **limits)
    assert isinstance(made, UltragrayVectorEnv)
    del limits["max_episode_steps"]
    single = SyncVectorEnv(
        [lambda: gymnasium.make(STANDARD_PLANE, max_episode_steps=4, scene=scene, **limits)] * COUNT,
        autoreset_mode=mode,
    )
    assert made.observation_space == single.observation_space
    assert made.action_space == single.action_space
    assert made.metadata["autoreset_mode"] is mode
    made.action_space.seed(0)
    both = [env.reset(seed=7) for env in (made, single)]
    ends = 0
    for _ in range(11):
        assert_alike(*both)
        actions = made.action_space.sample()
        both = [env.step(actions) for env in (made, single)]
        ended = both[0][2] | both[0][3]
        ends += ended.sum()
        if mode is AutoresetMode.DISABLED and ended.any():
            assert_alike(*both)
            both = [env.reset(options={"reset_mask": ended}) for env in (made, single)]
            both = [(*one[:1], {k: v[ended] for k, v in one[1].items()}) for one in both]
    assert ends > COUNT


def assert_alike(one, other, path=""):
    if isinstance(other, dict):
        assert set(one) == set(other), path
        for key in other:
            mask = other.get(f"_{key}")  # what a mask leaves out says nothing
            plain = mask is None or isinstance(other[key], dict) or other[key].dtype.kind == "O"
            pair = (each[key] if plain else each[key][mask] for each in (one, other))
            assert_alike(*pair, f"{path}/{key}")
    elif isinstance(other, tuple):
        for number, (a, b) in enumerate(zip(one, other, strict=True)):
            assert_alike(a, b, f"{path}/{number}")
    elif isinstance(other, np.ndarray) and other.dtype.kind == "O":  # final observations, one by one
        for number, own in enumerate(other):
            if own is not None:
                assert_alike({key: values[number] for key, values in one.items()}, own, f"{path}/{number}")
    else:
        np.testing.assert_allclose(one, other, atol=1e-6, err_msg=path)


def test_observations_stay_tensors_where_the_renderer_is(scene):
    env = UltragrayVectorEnv(3, scene, **SMALL)
    frames, infos = env.reset(seed=0)
    assert (frames.dtype, frames.shape) == (torch.uint8, (3, 24, 20, 1))
    np.testing.assert_array_equal(np.from_dlpack(frames), frames.numpy())
    assert infos["similarity"].shape == (3,)
    assert infos["_similarity"].all()
    before = frames.clone()
    later, rewards, terminated, truncated, _ = env.step(torch.ones(3, 6))
    assert all(isinstance(one, torch.Tensor) for one in (later, rewards, terminated, truncated))
    assert (rewards.dtype, terminated.dtype) == (torch.float32, torch.bool)
    torch.testing.assert_close(frames, before)  # what was returned is the caller's
    arrays = UltragrayVectorEnv(3, scene, as_numpy=True, **SMALL)
    assert arrays.observation_space.contains(arrays.reset(seed=0)[0])


def test_several_scenes_take_turns(scene, random_scene):
    other = replace(random_scene(300, seed=5, info={"probe": PROBE}), training_poses=scene.training_poses)
    env = UltragrayVectorEnv(4, [scene, other], contact=None, as_numpy=True, **SMALL)
    pose = np.stack([scene.training_poses[4]] * 4)
    frames, infos = env.reset(options={"pose": pose})
    np.testing.assert_allclose(infos["similarity"], 1.0, atol=1e-6)
    np.testing.assert_array_equal(frames[0], frames[2])
    np.testing.assert_array_equal(frames[1], frames[3])
    assert not np.array_equal(frames[0], frames[1])


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_gymnasiums_checker_is_content_with_every_task(demo, name):
    made = gymnasium.make(name, scene=demo, render_mode="rgb_array", height=16, width=16, start_mm=3.0)
    check_env(made.unwrapped)


def test_coverage_is_rewarded_once(demo):
    env = UltragrayVectorEnv(2, demo, task="coverage", start_mm=2.0, start_deg=0.0, as_numpy=True, height=16, width=16)
    goal = env.tasks[0].goal
    _, infos = env.reset(options={"pose": np.stack([goal, goal])})
    first = infos["covered_share"]
    still = np.zeros((2, 6))
    _, rewards, *_ = env.step(still)
    np.testing.assert_allclose(rewards, 0.0, atol=0.2)
    elevation = still.copy()
    elevation[0, 1] = 1.0
    _, rewards, _, _, infos = env.step(elevation)
    assert rewards[0] > 5.0 > rewards[1]
    assert infos["covered_share"][0] > first[0] + 0.05
    assert infos["covered_share"][1] == first[1]


def test_a_vessel_is_followed_to_its_end(demo):
    """A probe that goes along the sweep is rewarded by the way, and told to have arrived."""
    env = UltragrayVectorEnv(1, demo, goal=60, task=TaskName.VESSEL, as_numpy=True, height=16, width=16, start_mm=5.0)
    start, goal = env.tasks[0].posts[0], env.tasks[0].goal
    _, infos = env.reset(options={"pose": start[None]})
    left_mm = infos["left_mm"][0]
    assert left_mm > 10.0
    pivot = np.array([0.0, 0.0, PROBE.pivot_depth_mm, 1.0])
    rewards, pose = [], start.copy()
    for _ in range(200):
        to_goal = pose[:3, :3].T @ ((goal - pose) @ pivot)[:3]
        step = np.clip(to_goal / env.settings.step_mm, -1.0, 1.0)
        _, reward, done, _, infos = env.step(np.concatenate([step, np.zeros(3)])[None])
        pose = infos["pose"][0]
        rewards.append(reward[0])
        if done[0]:
            break
    assert done[0]
    assert infos["left_mm"][0] <= env.settings.reached_mm
    assert max(rewards) > 0.3
    with pytest.raises(InvalidArgument, match=r"label must be a name .*bone, muscle, fat, vessel.*, got 'nerve'"):
        UltragrayVectorEnv(1, demo, task="vessel", label="nerve")


def test_a_needle_reaches_the_vessel(demo):
    env = UltragrayVectorEnv(2, demo, task="needle", as_numpy=True, height=32, width=32)
    goal = env.tasks[0].goal
    without, infos = env.reset(options={"pose": np.stack([goal, goal])})
    before = infos["tip_mm"]
    push = np.zeros((2, 7))
    push[0, 6] = 1.0
    total, done = 0.0, np.zeros(2, bool)
    while not done[0] and total < before[0]:
        frames, rewards, done, _, infos = env.step(push)
        total += rewards[0] * env.settings.step_mm
    assert done.tolist() == [True, False]
    assert infos["tip_mm"][1] == before[1]
    assert np.abs(frames[0].astype(int) - without[0]).max() > 50  # the needle is seen
    np.testing.assert_array_equal(frames[1], without[1])
    assert all(isinstance(tool, Needle) for (tool,) in env.tasks[0].tools(np.ones(2, bool)))


def test_a_mask_needs_a_least_confidence():
    with pytest.raises(InvalidArgument, match="needs min_confidence"):
        ScanSettings(low_confidence="mask")


def test_low_confidence_is_a_penalty_or_a_mask(demo):
    goal = demo.training_poses[100]
    aside = moved(goal[None], np.array([[0.0, 12.0, 0.0]]), np.array([[25.0, 0.0, 0.0]]), 0.0)
    pose = np.concatenate([goal[None], aside])
    shown = {"goal": goal, "height": 32, "width": 32, "contact": None, "as_numpy": True, "start_deg": 20.0}

    def looked(**more):
        env = UltragrayVectorEnv(2, demo, **shown, **more)
        env.reset(options={"pose": pose})
        return env.step(np.zeros((2, 6)))

    plain, unsure, masked = looked(), looked(min_confidence=0.9), looked(min_confidence=0.9, low_confidence="mask")
    confidence = unsure[4]["confidence"]
    assert confidence[1] < 0.9
    assert confidence[1] <= Assessor(demo.info, demo.training_poses).assess(aside)[0].confidence
    np.testing.assert_allclose(plain[1] - unsure[1], np.maximum(1.0 - confidence / 0.9, 0.0), atol=1e-6)
    np.testing.assert_array_equal(plain[0], unsure[0])
    assert (masked[0][1] <= plain[0][1]).all()
    assert (masked[0][1] == 0).sum() > (plain[0][1] == 0).sum()


@pytest.mark.parametrize(
    ("given", "match"),
    [
        ({"num_envs": 0}, "num_envs must be at least 1, got 0"),
        ({"task": "sleep"}, "task must be one of standard plane, coverage, vessel, needle, got 'sleep'"),
        ({"scene": []}, "scene must be a scene, its file, or some of them, got none"),
    ],
)
def test_mistakes_are_told(scene, given, match):
    with pytest.raises(InvalidArgument, match=match):
        UltragrayVectorEnv(**{"num_envs": 2, "scene": scene, **SMALL, **given})


def test_what_is_given_must_be_of_as_many_environments(scene):
    env = UltragrayVectorEnv(2, scene, **SMALL)
    with pytest.raises(InvalidArgument, match="seed must be one, or 2, got 3"):
        env.reset(seed=[1, 2, 3])
    with pytest.raises(InvalidArgument, match=r"options\.pose must be 2 poses, got 1"):
        env.reset(options={"pose": np.eye(4)})
    with pytest.raises(InvalidArgument, match=r"options\.reset_mask must be 2 booleans"):
        env.reset(options={"reset_mask": np.zeros(2, bool)})
    env.reset(seed=0)
    with pytest.raises(InvalidArgument, match="actions must be 2 times 6 finite numbers"):
        env.step(np.zeros((1, 6)))


def test_pictures_are_of_each_environment(scene):
    env = UltragrayVectorEnv(2, scene, render_mode="rgb_array", **SMALL)
    env.reset(seed=0)
    assert [picture.shape for picture in env.render()] == [(24, 40, 3)] * 2
    assert UltragrayEnv(scene, task="coverage", render_mode="rgb_array", contact=None, **SMALL).render().shape == (
        24,
        20,
        3,
    )
