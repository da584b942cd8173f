"""An agent without learning that scans to a standard plane in the demo scene, by looking at what each motion brings.

    python examples/standard_plane.py --episodes 5

It tries a motion, repeats it while the reward rises, and takes it back where it falls: a bar that any agent that learns
should pass. It needs ultragray with its extra gym, and no service.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from ultragray.phantom.demo import DEMO_FILE
from ultragray_studies.gym import STANDARD_PLANE

Floats = npt.NDArray[np.float64]

MOST_STEPS = 1000
BOLDNESS = (0.1, 1.0)  # shares of the largest motion that are tried, drawn evenly in their logarithm


@dataclass
class Climber:
    """The rewards it has seen decide: nothing of the goal is known to it."""

    random: np.random.Generator
    last: Floats = field(default_factory=lambda: np.zeros(6))
    best: float = -np.inf
    undoing: bool = False

    def act(self, reward: float) -> Floats:  # [6]
        """The next motion, after the reward that the last one brought."""
        if self.undoing:  # back where the best reward was
            self.undoing = False
            self.last = self._another()
        elif reward > self.best:
            self.best = reward  # on in the same way
        else:
            self.undoing = True
            return -self.last
        return self.last

    def _another(self) -> Floats:
        """Along or about one axis, or all at once."""
        size = np.exp(self.random.uniform(*np.log(BOLDNESS)))
        motion = self.random.normal(size=6)
        if self.random.random() < 0.5:
            motion *= np.arange(6) == self.random.integers(6)
        return size * motion / np.abs(motion).max()


@dataclass(frozen=True)
class Episode:
    """How one ended."""

    steps: int
    reached: bool
    first: dict[str, Any]  # what the environment told at the start
    last: dict[str, Any]

    def tell(self) -> str:
        """One line."""
        end = f"reached in {self.steps} steps" if self.reached else f"not reached in {self.steps} steps"
        places = (f"{told['distance_mm']:.1f} mm and {told['angle_deg']:.1f}°" for told in (self.first, self.last))
        likeness = f"similarity {self.first['similarity']:.2f} → {self.last['similarity']:.2f}"
        return f"{end}: {' → '.join(places)} off the goal, {likeness}, contact {self.last['contact_share']:.0%}"


def scan(env: gymnasium.Env[Any, Any], seed: int) -> Episode:
    """One episode."""
    _, first = env.reset(seed=seed)
    agent, reward, steps = Climber(np.random.default_rng(seed)), -np.inf, 0
    while True:
        _, reward, reached, over, told = env.step(agent.act(float(reward)))
        steps += 1
        if reached or over:
            return Episode(steps, reached, first, told)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default=DEMO_FILE, help="a scene file")
    parser.add_argument("--episodes", type=int, default=5)
    parser.add_argument("--start-mm", type=float, default=6.0)
    parser.add_argument("--start-deg", type=float, default=6.0)
    given = parser.parse_args()
    env = gymnasium.make(
        STANDARD_PLANE,
        max_episode_steps=MOST_STEPS,
        scene=given.scene,
        start_mm=given.start_mm,
        start_deg=given.start_deg,
    )
    episodes = [scan(env, seed) for seed in range(given.episodes)]
    for episode in episodes:
        print(episode.tell())
    print(f"{sum(episode.reached for episode in episodes)} of {len(episodes)} reached the plane")


if __name__ == "__main__":
    main()
