"""The climbing agent finds the plane from nearby, and is told nothing of the goal but its reward."""

import subprocess
import sys

import gymnasium
import numpy as np
import pytest

from ultragray.phantom.demo import DEMO_FILE
from ultragray_studies.gym import STANDARD_PLANE

from .conftest import EXAMPLES


@pytest.fixture(scope="module")
def example(load_example):
    return load_example("standard_plane")


def test_the_agent_takes_back_what_did_not_help(example):
    agent = example.Climber(np.random.default_rng(0))
    agent.act(-1.0)
    agent.last = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert agent.act(-0.5)[0] == 1.0  # it helped: once more
    assert agent.act(-0.6)[0] == -1.0  # it did not: back
    assert agent.act(-0.5).any()  # something else
    assert agent.best == -0.5


@pytest.mark.slow
def test_it_comes_nearer_to_the_plane(example):
    env = gymnasium.make(STANDARD_PLANE, scene=DEMO_FILE, height=64, width=64, start_mm=4.0, start_deg=4.0)
    episodes = [example.scan(env, seed) for seed in range(2)]
    first, last = (np.mean([getattr(one, when)["similarity"] for one in episodes]) for when in ("first", "last"))
    assert last > first + 0.2
    off = [[getattr(one, when)["distance_mm"] for one in episodes] for when in ("first", "last")]
    assert np.mean(off[1]) < np.mean(off[0])


@pytest.mark.long
@pytest.mark.slow
def test_as_a_program():
    command = [sys.executable, EXAMPLES / "standard_plane.py", "--episodes", "1", "--start-mm", "2", "--start-deg", "2"]
    told = subprocess.run(command, check=True, capture_output=True, text=True, timeout=120).stdout
    assert "off the goal, similarity" in told
    assert "of 1 reached the plane" in told
