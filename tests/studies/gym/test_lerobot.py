"""Data sets in LeRobot's format: what is written is read back, and is laid out as its own reader wants it.

The package itself is not among the test's: its releases ask for an older torch.
"""

import json
import math
from dataclasses import replace

import gymnasium
import numpy as np
import pyarrow.parquet
import pytest

from ultragray import LinearProbe
from ultragray.errors import InvalidArgument
from ultragray_studies.gym import STANDARD_PLANE
from ultragray_studies.gym.lerobot import Episode, read_lerobot, rollout, write_lerobot

SHOWN = {"height": 16, "width": 12, "contact": None}
TASK = "Scan to the standard plane."


@pytest.fixture(scope="module")
def env(random_scene):
    scene = random_scene(200, info={"probe": LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=40.0)})
    scene = replace(scene, training_poses=np.eye(4)[None])
    return gymnasium.make(STANDARD_PLANE, scene=scene, with_pose=True, max_episode_steps=4, **SHOWN)


@pytest.fixture(scope="module")
def episodes(env):
    env.action_space.seed(0)
    return [rollout(env, lambda *_: env.action_space.sample(), TASK, seed) for seed in range(3)]


def test_what_is_written_is_read_back(episodes, tmp_path):
    done = replace(episodes[1], is_done=True, task="Another.")
    write_lerobot(tmp_path / "set", [episodes[0], done, episodes[2]], fps=10)
    read = read_lerobot(tmp_path / "set")
    assert [one.task for one in read] == [TASK, "Another.", TASK]
    assert [one.is_done for one in read] == [False, True, False]
    for one, other in zip(read, episodes, strict=True):
        for name in ("frames", "poses", "actions", "rewards"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
            assert getattr(one, name).dtype == getattr(other, name).dtype


def test_the_folder_is_laid_out_as_version_3_has_it(episodes, tmp_path):
    write_lerobot(tmp_path / "set", episodes, fps=10)
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert (info["codebase_version"], info["total_episodes"], info["total_frames"], info["fps"]) == ("v3.0", 3, 12, 10)
    path = info["data_path"].format(chunk_index=0, file_index=0)
    data = pyarrow.parquet.read_table(tmp_path / "set" / path)
    assert set(data.column_names) == set(info["features"])
    assert data["timestamp"].to_pylist()[4:8] == pytest.approx([0.0, 0.1, 0.2, 0.3])
    assert data["index"].to_pylist() == list(range(12))
    assert data["episode_index"].to_pylist() == [0] * 4 + [1] * 4 + [2] * 4
    assert data.schema.field("action").type.list_size == info["features"]["action"]["shape"][0] == 6
    rows = pyarrow.parquet.read_table(tmp_path / "set/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [(row["dataset_from_index"], row["dataset_to_index"]) for row in rows] == [(0, 4), (4, 8), (8, 12)]
    stats = json.loads((tmp_path / "set/meta/stats.json").read_text())
    assert set(stats) == set(info["features"])
    assert np.shape(stats["observation.images.bmode"]["mean"]) == (1, 1, 1)
    assert 0.0 < stats["observation.images.bmode"]["mean"][0][0][0] < 1.0


def test_mistakes_are_told(episodes, env, tmp_path):
    (tmp_path / "old/meta").mkdir(parents=True)
    (tmp_path / "old/meta/info.json").write_text('{"codebase_version": "v2.1"}')
    with pytest.raises(InvalidArgument, match=r"of version v3\.0, got 'v2\.1'"):
        read_lerobot(tmp_path / "old")
    with pytest.raises(InvalidArgument, match="holds no LeRobot data set"):
        read_lerobot(tmp_path / "none")
    for fps in (0, -5, math.nan):
        with pytest.raises(InvalidArgument, match="fps must be greater than 0"):
            write_lerobot(tmp_path / "new", episodes, fps=fps)
    with pytest.raises(InvalidArgument, match="folder must not exist yet"):
        write_lerobot(tmp_path / "old", episodes)
    with pytest.raises(InvalidArgument, match="got 0 kinds of them"):
        write_lerobot(tmp_path / "new", [])
    with pytest.raises(InvalidArgument, match=r"as many frames, .* got \[4, 4, 3, 4\]"):
        Episode(**{**vars(episodes[0]), "actions": episodes[0].actions[1:]})
    blind = gymnasium.make(STANDARD_PLANE, scene=env.unwrapped._only.tasks[0].site.scene, **SHOWN)
    with pytest.raises(InvalidArgument, match="make it with with_pose=True"):
        rollout(blind, lambda *_: np.zeros(6), TASK)
