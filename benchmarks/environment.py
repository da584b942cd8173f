"""Steps a second of the environment StandardPlane-v0 with a random policy, on the demo scene.

    python benchmarks/environment.py

1,000 steps of each case, resets included, three times in turn, on one thread: two cores carry two environments.
"""

from __future__ import annotations

import time
from itertools import product
from typing import Any

import gymnasium
import numpy as np
import torch

from measuring import write
from ultragray.phantom.demo import DEMO_FILE
from ultragray.scene.gaussians import GaussianScene
from ultragray_studies.bench.report import measured
from ultragray_studies.gym import STANDARD_PLANE

SIDES = (64, 128, 256)
CONTACTS = (None, "air")
THREADS = 1
STEPS, UNCOUNTED, ROUNDS = 1000, 50, 3

Row = dict[str, Any]


def main() -> None:
    scene = GaussianScene.load(DEMO_FILE)
    torch.set_num_threads(THREADS)
    cases = list(product(SIDES, CONTACTS))
    took_ms: dict[tuple[int, str | None], list[list[float]]] = {case: [] for case in cases}
    for case in cases * ROUNDS:  # in turn, so that a busy minute of the machine is not one case's
        took_ms[case].append(steps_of_random_policy(scene, *case))
    document = {
        "measured": measured(THREADS),
        "gaussians": scene.gaussian_count,
        "steps": STEPS,
        "rounds": ROUNDS,
        "rows": [row(*case, rounds) for case, rounds in took_ms.items()],
    }
    write("environment", document)


def steps_of_random_policy(scene: GaussianScene, side: int, contact: str | None) -> list[float]:
    """The time of each step, with the reset that may follow it, ms."""
    env = gymnasium.make(STANDARD_PLANE, scene=scene, height=side, width=side, contact=contact)
    env.action_space.seed(0)
    env.reset(seed=0)
    took_ms = []
    for _ in range(UNCOUNTED + STEPS):
        began = time.perf_counter()
        *_, reached, over, _ = env.step(env.action_space.sample())
        if reached or over:
            env.reset()
        took_ms.append(1000.0 * (time.perf_counter() - began))
    return took_ms[UNCOUNTED:]


def row(side: int, contact: str | None, rounds: list[list[float]]) -> Row:
    """Steps a second in the median round, and the time of one step over all rounds."""
    p50_ms, p99_ms = np.percentile(np.concatenate(rounds), (50, 99)).tolist()
    return {
        "side": side,
        "contact": contact,
        "steps_per_s": float(np.median([1000.0 * STEPS / sum(took_ms) for took_ms in rounds])),
        "p50_ms": p50_ms,
        "p99_ms": p99_ms,
    }


if __name__ == "__main__":
    main()
